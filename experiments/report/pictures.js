"use strict";

// What fingers and camera saw, in step with the playback: of each the newest picture that had been taken by then.
// A finger's grey values are lengths; they get their colours here, and the same scale in every picture of a trial.
(() => {
  const holder = document.getElementById("pictures"), facts = document.getElementById("pictures-facts");
  const found = document.getElementById("pictures-data");
  const data = found ? JSON.parse(found.textContent) : { trials: [], imagers: [] };
  const drawn = new Map();  // shot → the canvas with its picture
  let strips = [];

  const channels = (colour) => [1, 3, 5].map((i) => parseInt(colour.slice(i, i + 2), 16));
  const palette = (data.colours || []).map(channels);
  const colourAt = (share) => {
    const at = Math.min(1, Math.max(0, share)) * (palette.length - 1), i = Math.min(palette.length - 2, Math.floor(at)), s = at - i;
    return palette[i].map((low, c) => low + s * (palette[i + 1][c] - low));
  };

  const coloured = (context, strip) => {
    const image = context.getImageData(0, 0, strip.width, strip.height), pixels = image.data;
    const table = Array.from({ length: 256 }, (_, grey) => colourAt((grey - data.zero) * data.unit / strip.reach));
    for (let i = 0; i < pixels.length; i += 4) [pixels[i], pixels[i + 1], pixels[i + 2]] = table[pixels[i]];
    context.putImageData(image, 0, 0);
  };

  const make = async (strip, shot) => {
    const image = new Image();
    image.src = `data:image/jpeg;base64,${shot[2]}`;
    await image.decode();
    const canvas = Object.assign(document.createElement("canvas"), { width: strip.width, height: strip.height });
    const context = canvas.getContext("2d", { willReadFrequently: strip.kind === "deformation" });
    context.drawImage(image, 0, 0);
    if (strip.kind === "deformation") coloured(context, strip);
    return canvas;
  };

  const put = async (seat, shot) => {
    if (!drawn.has(shot)) drawn.set(shot, make(seat.strip, shot));
    try {
      const picture = await drawn.get(shot);
      if (seat.shot === shot) seat.canvas.getContext("2d").drawImage(picture, 0, 0);  // the time may have gone on
    } catch {
      if (seat.shot === shot) seat.caption.textContent = "this picture cannot be read";
    }
  };

  const seated = (strip) => {
    const figure = document.createElement("figure"), caption = document.createElement("figcaption");
    const canvas = Object.assign(document.createElement("canvas"), { width: strip.width, height: strip.height });
    const deformed = strip.kind === "deformation";
    canvas.setAttribute("role", "img");
    canvas.setAttribute("aria-label", deformed ? `Deformation of the membrane of ${strip.device}` : `Picture of ${strip.device}`);
    const name = Object.assign(document.createElement("strong"), { textContent: strip.device });
    const when = Object.assign(document.createElement("span"), { className: "note" });
    caption.append(name, " ", when);
    figure.append(canvas, caption);
    figure.className = deformed ? "finger-picture" : "camera-picture";
    return { strip, figure, canvas, caption: when, shot: null };
  };

  const scale = (fingers) => {
    const bar = document.createElement("div"), reach = fingers[0].reach;
    bar.className = "colour-scale";
    const ends = ["0", `${reach.toFixed(1)} mm`].map((text) => Object.assign(document.createElement("span"), { textContent: text }));
    const ramp = document.createElement("i");
    ramp.style.background = `linear-gradient(90deg, ${data.colours.join(", ")})`;
    const against = [...new Set(fingers.map((strip) => strip.against))].join(" and ");
    const said = Object.assign(document.createElement("span"), {
      className: "note", textContent: `toward the finger's camera, against ${against}`,
    });
    bar.append(ends[0], ramp, ends[1], said);
    return bar;
  };

  const choose = (index) => {
    const own = data.trials[index] || [], fingers = own.filter((strip) => strip.kind === "deformation");
    strips = own.map(seated);
    drawn.clear();
    holder.replaceChildren(...strips.map((seat) => seat.figure));
    if (fingers.length) holder.append(scale(fingers));
    const silent = data.imagers.filter((device) => !own.some((strip) => strip.device === device)), note = document.getElementById("no-pictures");
    note.hidden = own.length > 0 && silent.length === 0;
    note.textContent = `The log has no picture of ${silent.join(", ") || "fingers or camera"} in this trial: `
      + "they send pictures only while somebody listens, and in lockstep only when a controller looks.";
    const count = Math.max(0, ...own.map((strip) => strip.shots.length)), all = Player.data.trials[index].waypoints?.t.length || 0;
    facts.textContent = own.length ? `as of the newest waypoint${count < all ? `; ${count} of ${all} waypoints have one` : ""}` : "";
    show(Player.time);
  };

  const show = (time) => {
    for (const seat of strips) {
      const { shots } = seat.strip, newest = shots.findLast((shot) => shot[0] <= time + 1e-6), shot = newest || shots[0];
      seat.figure.classList.toggle("ahead", !newest);
      if (shot === seat.shot) continue;
      seat.shot = shot;
      seat.caption.textContent = `waypoint ${shot[1] + 1}, ${shot[0].toFixed(2)} s`;
      put(seat, shot);
    }
  };

  Player.on("trial", choose);
  Player.on("time", show);
  choose(Player.index);
})();
