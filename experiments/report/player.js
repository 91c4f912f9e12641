"use strict";

// Time: slider, play, keyboard, trial selector; what the scene and the read-outs show at an instant.
const Player = (() => {
  const $ = (id) => document.getElementById(id);
  const data = JSON.parse($("data").textContent);
  const listeners = { trial: [], time: [] };
  const ROWS = [["go", "mm"], ["eo", "mm"], ["ee", "mm"], ["wrench", "N"]];
  const POSE = [["x", "mm", 1000, 2], ["y", "mm", 1000, 2], ["θ", "deg", 180 / Math.PI, 2]];
  const WRENCH = [["fx", "N", 1, 3], ["fy", "N", 1, 3], ["τ", "N·mm", 1000, 1]];

  let trial = null, scene = null, compliance = null, cells = [], time = 0, kept = null, playing = false, last = 0;

  const format = (value, digits) => value === null ? "–" : Scene.number(value, digits);
  const span = () => trial.playback ? [trial.playback.t[0], trial.playback.t.at(-1)] : [0, 0];

  // Index of the last entry of the ascending list that is not after t, at least 0.
  const before = (list, t) => {
    let low = 0, high = list.length - 1;
    while (low < high) {
      const middle = (low + high + 1) >> 1;
      if (list[middle] <= t + 1e-9) low = middle; else high = middle - 1;
    }
    return low;
  };

  const frameAt = (t) => {
    const p = trial.playback, i = before(p.t, t), j = Math.min(i + 1, p.t.length - 1);
    const gap = p.t[j] - p.t[i], s = gap > 0 ? Math.min(1, Math.max(0, (t - p.t[i]) / gap)) : 0;
    const mix = (rows, angular) => {
      const a = rows?.[i], b = rows?.[j];
      if (!a || !b || s === 0) return a || null;
      const third = angular ? Scene.wrap(b[2] - a[2]) : b[2] - a[2];
      return [a[0] + s * (b[0] - a[0]), a[1] + s * (b[1] - a[1]), a[2] + s * third];
    };
    return {
      ee: mix(p.ee, true), go: mix(p.go, true), eo: mix(p.eo, true), wrench: mix(p.wrench, false), contacts: p.contacts[i],
    };
  };

  // The waypoint that is under way at t: the first one not yet passed, the last one after all.
  const target = (t) => {
    const times = trial.waypoints?.t;
    if (!times) return -1;
    const k = times.findIndex((moment) => moment >= t - 1e-9);
    return k < 0 ? times.length - 1 : k;
  };
  const plannedAt = (k) => {
    const planned = trial.waypoints?.planned;
    if (k < 0 || !planned) return null;
    const at = (key) => planned[key]?.[k] || null;
    return { ee: at("ee"), go: at("go"), eo: at("eo"), contacts: trial.waypoints.contacts[k] };
  };

  const buildValues = () => {
    const body = $("values").tBodies[0];
    body.replaceChildren();
    cells = [];
    for (const [series] of ROWS) {
      const sources = [trial.playback, trial.waypoints?.planned, trial.waypoints?.measured, trial.waypoints?.truth];
      if (!sources.some((s) => s?.[series])) continue;
      (series === "wrench" ? WRENCH : POSE).forEach(([symbol, unit, factor, digits], component) => {
        const row = body.insertRow();
        if (component === 0) row.className = "first";
        const head = (text) => { const th = document.createElement("th"); th.scope = "row"; th.textContent = text; row.append(th); };
        head(component === 0 ? series : "");
        head(`${symbol} [${unit}]`);
        const numbers = [0, 1, 2, 3].map(() => { const td = row.insertCell(); td.className = "number"; return td; });
        cells.push({ series, component, factor, digits, numbers });
      });
    }
    const source = trial.playback?.source || "";
    $("now-head").title = source;
    const thinned = trial.playback && trial.playback.recorded > trial.playback.t.length
      ? ` Shown: ${trial.playback.t.length} of ${trial.playback.recorded} recorded frames.` : "";
    $("values-note").textContent = `now: ${source}; planned, measured and truth: at the waypoint under way.${thinned}`;
  };

  const buildTimeline = () => {
    const [start, end] = span(), at = (t) => `${(t - start) / Math.max(end - start, 1e-9) * 100}%`;
    const slider = $("time"), ticks = $("ticks"), phases = $("phases");
    slider.min = start; slider.max = end;
    ticks.replaceChildren(); phases.replaceChildren();
    (trial.waypoints?.t || []).forEach((t, k) => {
      if (!trial.waypoints.reached[k] || t < start || t > end) return;
      const tick = document.createElement("i");
      tick.style.left = at(t); tick.dataset.waypoint = k;
      ticks.append(tick);
    });
    for (const [name, from, to] of trial.playback?.phases || []) {
      const label = document.createElement("span");
      label.textContent = name.replaceAll("_", " "); label.title = label.textContent;
      label.style.left = at(from); label.style.width = `calc(${at(to)} - ${at(from)})`;
      label.dataset.from = from; label.dataset.to = to;
      phases.append(label);
    }
  };

  const drawContacts = (contacts) => {
    $("contacts").replaceChildren(...contacts.map((c) => {
      const mode = data.modes[c[4]], shape = Scene.kind(mode), item = document.createElement("li");
      const svg = Scene.el("svg", { class: `swatch mode-${shape}`, viewBox: "-8 -8 16 16", "aria-hidden": "true" }, item);
      Scene.el("path", { class: "marker", d: Scene.MARKERS[shape] }, svg);
      item.append(`${c[5] ? c[5] + " " : ""}${mode.replace("-", "−")}, ${Math.hypot(c[2], c[3]).toFixed(2)} N`);
      return item;
    }));
  };

  const draw = () => {
    if (!trial.playback) return;
    const frame = frameAt(time), k = target(time), planned = plannedAt(k);
    const options = { plan: $("show-plan").checked, forces: $("show-forces").checked, cones: $("show-cones").checked };
    scene.draw(frame, planned, options);
    compliance.draw(frame, planned, options);
    drawContacts(frame.contacts);
    for (const { series, component, factor, digits, numbers } of cells) {
      const rows = [frame[series], ...["planned", "measured", "truth"].map((s) => trial.waypoints?.[s]?.[series]?.[k])];
      rows.forEach((row, i) => { numbers[i].textContent = format(row ? row[component] * factor : null, digits); });
    }
    const count = trial.waypoints?.t.length || 0, phase = (trial.playback.phases.findLast((p) => p[1] <= time + 1e-9) || [""])[0];
    const clock = [`${time.toFixed(2)} s of ${span()[1].toFixed(2)} s`, count ? `waypoint ${k + 1} of ${count}` : "", phase.replaceAll("_", " ")].filter(Boolean).join("\n");
    $("clock").textContent = clock;
    $("time").value = time;
    $("time").setAttribute("aria-valuetext", clock.replaceAll("\n", ", "));
    for (const tick of $("ticks").children) tick.classList.toggle("current", Number(tick.dataset.waypoint) === k);
    for (const label of $("phases").children) label.classList.toggle("current", phase !== "" && Number(label.dataset.from) <= time + 1e-9 && time < Number(label.dataset.to) + 1e-9);
    for (const listener of listeners.time) listener(time);
  };

  const move = (t) => {
    const [start, end] = span();
    time = Math.min(end, Math.max(start, t));
    draw();
  };
  const seek = (t) => { kept = null; move(t); };

  // A look at another instant, from which `release` leads back; while it plays, nothing does.
  const preview = (t) => {
    if (playing || !trial.playback) return;
    kept ??= time;
    move(t);
  };
  const release = () => { if (kept !== null) seek(kept); };

  const play = (on) => {
    if (on && !trial.playback) return;
    playing = on;
    $("play").textContent = on ? "Pause" : "Play";
    $("play").setAttribute("aria-pressed", String(on));
    if (!on) return;
    if (time >= span()[1] - 1e-6) time = span()[0];
    last = performance.now();
    requestAnimationFrame(advance);
  };
  const advance = (now) => {
    if (!playing) return;
    const step = Math.max(0, now - last) / 1000 * Number($("speed").value);
    last = now;
    seek(time + step);
    if (time >= span()[1]) play(false); else requestAnimationFrame(advance);
  };

  const toWaypoint = (direction) => {
    play(false);
    const times = (trial.waypoints?.t || []).filter((_, k) => trial.waypoints.reached[k]);
    const next = direction > 0 ? times.find((t) => t > time + 1e-6) : times.findLast((t) => t < time - 1e-6);
    seek(next ?? span()[direction > 0 ? 1 : 0]);
  };
  const toFrame = (direction) => {
    play(false);
    const t = trial.playback.t, i = before(t, time);
    const j = direction > 0 ? i + 1 : t[i] < time - 1e-6 ? i : i - 1;
    seek(t[Math.min(t.length - 1, Math.max(0, j))]);
  };

  const choose = (index) => {
    play(false);
    trial = data.trials[index];
    $("trial-name").textContent = trial.name;
    $("trial-facts").textContent = [trial.skill, trial.controller, trial.status].filter(Boolean).map((w) => w.replaceAll("_", " ")).join(" · ")
      + (trial.reason ? `: ${trial.reason}` : "");
    $("stage").hidden = !trial.playback;
    $("no-playback").hidden = Boolean(trial.playback);
    if (trial.playback) {
      scene = Scene.create($("scene"), data, trial);
      compliance = Scene.createCompliance($("compliance"), data, trial);
      buildValues();
      buildTimeline();
      const first = trial.waypoints?.reached.indexOf(true) ?? -1;
      seek(first >= 0 ? trial.waypoints.t[first] : span()[0]);
    }
    for (const listener of listeners.trial) listener(index);
  };

  const KEYS = {
    " ": () => play(!playing), ArrowLeft: () => toWaypoint(-1), ArrowRight: () => toWaypoint(1),
    ",": () => toFrame(-1), ".": () => toFrame(1),
    Home: () => { play(false); seek(span()[0]); }, End: () => { play(false); seek(span()[1]); },
  };
  document.addEventListener("keydown", (event) => {
    const action = KEYS[event.key], where = event.target;
    if (!action || !trial?.playback || event.ctrlKey || event.metaKey || event.altKey) return;
    if (where.closest("select, textarea, summary, a") || (event.key === " " && where.closest("button, input[type=checkbox]"))) return;
    const far = $("playback").getBoundingClientRect();
    if ((event.key === " " || event.key === "Home" || event.key === "End") && where === document.body && (far.bottom < 0 || far.top > innerHeight)) return;
    event.preventDefault();
    action();
  });
  $("time").addEventListener("input", () => { play(false); seek(Number($("time").value)); });
  $("play").addEventListener("click", () => play(!playing));
  $("previous").addEventListener("click", () => toWaypoint(-1));
  $("next").addEventListener("click", () => toWaypoint(1));
  $("trial").addEventListener("change", () => choose(Number($("trial").value)));
  for (const id of ["show-plan", "show-forces", "show-cones"]) $(id).addEventListener("change", draw);

  choose(0);
  performance.mark("interactive");  // slider, keys and scene answer from here on
  return {
    data, seek, preview, release, choose,
    on: (what, listener) => listeners[what].push(listener),
    get time() { return time; },
    get index() { return data.trials.indexOf(trial); },
  };
})();
