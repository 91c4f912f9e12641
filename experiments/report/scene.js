"use strict";

// The planar scene as SVG. Poses are [x, y, θ] in W, metres and radians; x right, y up, angles counter-clockwise.
const Scene = (() => {
  const WIDTH = 800, HEIGHT = 580;  // user units of the drawing
  const NS = "http://www.w3.org/2000/svg";
  const PAD = 0.02, PATCH = 0.013, STEM = 0.012;  // finger pad, membrane patch, half stem [m]; a drawing, not a model
  const SPOKES = 8;

  const el = (name, attributes, parent) => {
    const node = document.createElementNS(NS, name);
    for (const [key, value] of Object.entries(attributes || {})) node.setAttribute(key, value);
    if (parent) parent.appendChild(node);
    return node;
  };
  const show = (node, visible) => { node.style.display = visible ? "" : "none"; };

  const compose = (a, b) => {
    const c = Math.cos(a[2]), s = Math.sin(a[2]);
    return [a[0] + c * b[0] - s * b[1], a[1] + s * b[0] + c * b[1], a[2] + b[2]];
  };
  const wrap = (angle) => Math.atan2(Math.sin(angle), Math.cos(angle));
  const between = (a, b) => {  // the pose of b in a
    const c = Math.cos(a[2]), s = Math.sin(a[2]), dx = b[0] - a[0], dy = b[1] - a[1];
    return [c * dx + s * dy, c * dy - s * dx, wrap(b[2] - a[2])];
  };
  // 1, 2 or 5 times a power of ten, at most `value`
  const nice = (value) => {
    const power = 10 ** Math.floor(Math.log10(value));
    return ([5, 2, 1].find((m) => m * power <= value * (1 + 1e-9)) || 1) * power;
  };

  // With a real minus sign, and none before zero.
  const number = (value, digits) => {
    const text = value.toFixed(digits);
    return Number(text) === 0 ? text.replace("-", "") : text.replace("-", "−");
  };

  const outline = (vertices) => vertices.length ? "M" + vertices.map((v) => v.join(" ")).join("L") + "Z" : "";
  const RIM = Math.sqrt(PAD * PAD - STEM * STEM);
  const FINGER = `M${-STEM} .05V${RIM}A${PAD} ${PAD} 0 1 1 ${STEM} ${RIM}V.05L.03 .064V.086H-.03V.064Z`;
  const FINGER_CORNERS = [[-0.03, 0.086], [0.03, 0.086], [-PAD, -PAD], [PAD, -PAD]];
  const circle = (r) => `M${r} 0A${r} ${r} 0 1 1 ${-r} 0A${r} ${r} 0 1 1 ${r} 0Z`;
  const axes = (length) => `M${length} 0H0V${length}`;
  const MARKERS = {
    stick: "M5.5 0A5.5 5.5 0 1 1 -5.5 0A5.5 5.5 0 1 1 5.5 0Z",
    slip: "M0 -7.5L7.5 0L0 7.5L-7.5 0Z",
    free: "M5 0A5 5 0 1 1 -5 0A5 5 0 1 1 5 0Z",
  };
  const kind = (mode) => mode.startsWith("slip") ? "slip" : mode;

  // A filled arrow in pixels from (x, y) along (dx, dy); empty when too short to have a direction.
  const arrow = (x, y, dx, dy) => {
    const length = Math.hypot(dx, dy);
    if (!(length > 3)) return "";
    const ux = dx / length, uy = dy / length, head = Math.min(10, length * 0.6), w = 1.4, h = head * 0.5;
    const at = (along, across) => `${(x + along * ux - across * uy).toFixed(2)} ${(y + along * uy + across * ux).toFixed(2)}`;
    const neck = length - head;
    return `M${at(0, w)}L${at(neck, w)}L${at(neck, h)}L${at(length, 0)}L${at(neck, -h)}L${at(neck, -w)}L${at(0, -w)}Z`;
  };

  // Everything that the trial will ever show, in metres: [left, bottom, right, top].
  const bounds = (data, trial) => {
    const box = [Infinity, 0, -Infinity, 0.05];
    const take = (x, y) => {
      box[0] = Math.min(box[0], x); box[1] = Math.min(box[1], y);
      box[2] = Math.max(box[2], x); box[3] = Math.max(box[3], y);
    };
    const corners = { go: data.objects.go?.vertices || [], eo: data.objects.eo?.vertices || [], ee: FINGER_CORNERS };
    for (const series of [trial.playback, trial.waypoints?.planned, trial.waypoints?.measured, trial.waypoints?.truth]) {
      for (const body of ["go", "eo", "ee"]) {
        for (const pose of series?.[body] || []) {
          if (pose) for (const v of corners[body]) { const p = compose(pose, [v[0], v[1], 0]); take(p[0], p[1]); }
        }
      }
    }
    if (!Number.isFinite(box[0])) { box[0] = -0.1; box[2] = 0.1; }
    return box;
  };

  const strongest = (trial) => {
    const sizes = [];
    for (const step of trial.playback?.contacts || []) for (const c of step) sizes.push(Math.hypot(c[2], c[3]));
    for (const step of trial.waypoints?.contacts || []) for (const c of step) sizes.push(Math.hypot(c[2], c[3]));
    for (const w of trial.playback?.wrench || []) if (w) sizes.push(Math.hypot(w[0], w[1]));
    sizes.sort((a, b) => a - b);
    return sizes.length ? sizes[Math.floor((sizes.length - 1) * 0.99)] : 0;  // a spike at impact does not shrink the rest
  };

  const create = (svg, data, trial) => {
    svg.replaceChildren();
    const [left, bottom, right, top] = bounds(data, trial);
    const scale = Math.min((WIDTH - 90) / (right - left), (HEIGHT - 80) / (top - bottom));  // px per metre
    const originX = WIDTH / 2 - scale * (left + right) / 2;
    const originY = HEIGHT - 58 + scale * Math.min(bottom, 0);
    const px = (x, y) => [originX + scale * x, originY - scale * y];

    const hatch = el("path", { class: "hatch" }, svg);
    hatch.setAttribute("d", Array.from({ length: WIDTH / 10 + 1 }, (_, i) => `M${i * 10} ${originY}l-8 8`).join(""));
    el("path", { class: "ground", d: `M0 ${originY}H${WIDTH}` }, svg);

    const world = el("g", { class: "world", transform: `matrix(${scale} 0 0 ${-scale} ${originX} ${originY})` }, svg);
    const part = (cls, d) => el("path", { class: cls, d }, world);
    const goOutline = outline(data.objects.go?.vertices || []), eoOutline = outline(data.objects.eo?.vertices || []);
    const parts = { eo: part("eo body-eo", eoOutline), go: part("go body-go", goOutline) };
    parts.ee = part("finger body-ee", FINGER);
    parts.patch = part("patch", circle(PATCH));
    const membrane = el("path", { class: "membrane" }, svg);
    parts.gocf = part("axis-gocf", axes(0.012));
    parts.axes = part("axis-ee", axes(0.012));
    const ghosts = { eo: part("ghost ghost-eo", eoOutline), go: part("ghost ghost-go", goOutline), ee: part("ghost ghost-ee", circle(PAD)) };
    const over = el("g", {}, svg);

    const place = (node, pose) => {
      show(node, Boolean(pose));
      if (pose) node.setAttribute("transform", `translate(${pose[0]} ${pose[1]}) rotate(${pose[2] * 180 / Math.PI})`);
    };

    // Scales: length at the left, force beside it, both under the ground.
    const force = strongest(trial), perNewton = force > 0 ? 110 / force : 0;
    const length = nice(140 / scale), bar = length * scale, y = HEIGHT - 20;
    el("path", { class: "scale", d: `M16 ${y - 4}v8M16 ${y}h${bar}M${16 + bar} ${y - 4}v8` }, svg);
    el("text", { class: "quiet", x: 22 + bar, y: y + 4 }, svg).textContent = `${+(length * 1000).toPrecision(3)} mm`;
    if (force > 0) {
      const unit = nice(60 / perNewton), x = 110 + bar;
      el("path", { class: "arrow scale-arrow", d: arrow(x, y, unit * perNewton, 0) }, svg);
      el("text", { class: "quiet", x: x + unit * perNewton + 7, y: y + 4 }, svg).textContent = `${+unit.toPrecision(3)} N`;
    }
    const torque = Math.max(...(trial.playback?.wrench || []).map((w) => w ? Math.abs(w[2]) : 0), 1e-3);

    const label = (x, y, text, cls) => {
      const node = el("text", { class: `halo ${cls || ""}`, x: x.toFixed(1), y: y.toFixed(1) }, over);
      node.textContent = text;
    };
    const drawForce = (x, y, fx, fy, cls) => {
      const dx = fx * perNewton, dy = -fy * perNewton, d = arrow(x, y, dx, dy);
      if (!d) return;
      el("path", { class: `arrow ${cls}`, d }, over);
      if (cls !== "planned") label(x + dx + (dx < 0 ? -38 : 7), y + dy + 4, `${Math.hypot(fx, fy).toFixed(1)} N`);
    };
    const drawTorque = (x, y, value) => {
      const sweep = value / torque * 2.4, r = 30;  // full scale: 140°
      if (Math.abs(sweep) < 0.05) return;
      const [a, b] = [Math.PI / 2 - sweep / 2, Math.PI / 2 + sweep / 2];
      const at = (angle) => [x + r * Math.cos(angle), y - r * Math.sin(angle)];
      const [x0, y0] = at(a), [x1, y1] = at(b), side = Math.sign(sweep);
      el("path", { class: "torque", d: `M${x0} ${y0}A${r} ${r} 0 0 ${side > 0 ? 0 : 1} ${x1} ${y1}` }, over);
      const tip = arrow(x1, y1, -side * 9 * Math.sin(b), -side * 9 * Math.cos(b));
      el("path", { class: "arrow wrench", d: tip }, over);
    };

    // The cone that the plan believed in, at the contact that it is of; where nothing touches, where the plan has it.
    const NEAR = 0.015, LONG = 52;  // [m], [px]
    const drawCones = (contacts, plan) => {
      for (const [x, y, , , , , nx, ny, mu] of (plan || []).filter((c) => c.length > 8)) {
        const away = (c) => Math.hypot(c[0] - x, c[1] - y);
        const touching = contacts.filter((c) => away(c) < NEAR).sort((a, b) => away(a) - away(b))[0];
        const [cx, cy] = touching ? px(touching[0], touching[1]) : px(x, y), half = Math.atan(mu);
        const way = Math.atan2(ny, nx) + (touching && touching[2] * nx + touching[3] * ny < 0 ? Math.PI : 0);
        const at = (angle) => `${(cx + LONG * Math.cos(angle)).toFixed(2)} ${(cy - LONG * Math.sin(angle)).toFixed(2)}`;
        el("path", { class: "cone", d: `M${cx.toFixed(2)} ${cy.toFixed(2)}L${at(way - half)}A${LONG} ${LONG} 0 0 0 ${at(way + half)}Z` }, over);
      }
    };

    const draw = (frame, planned, options) => {
      for (const body of ["go", "eo", "ee"]) {
        place(parts[body], frame[body]);
        place(ghosts[body], options.plan ? planned?.[body] : null);
      }
      const gocf = frame.go ? compose(frame.go, data.grasp) : null;
      place(parts.patch, gocf); place(parts.gocf, gocf); place(parts.axes, frame.ee);
      let spokes = "";
      if (gocf && frame.ee) {
        for (let i = 0; i < SPOKES; i++) {
          const a = (i + 0.5) * 2 * Math.PI / SPOKES, c = Math.cos(a), s = Math.sin(a);
          const from = compose(gocf, [PATCH * c, PATCH * s, 0]), to = compose(frame.ee, [PAD * c, PAD * s, 0]);
          spokes += `M${px(from[0], from[1]).map((v) => v.toFixed(2)).join(" ")}L${px(to[0], to[1]).map((v) => v.toFixed(2)).join(" ")}`;
        }
      }
      membrane.setAttribute("d", spokes);
      over.replaceChildren();
      if (options.cones) drawCones(frame.contacts, planned?.contacts);
      if (options.forces) {
        if (options.plan) for (const c of planned?.contacts || []) drawForce(...px(c[0], c[1]), c[2], c[3], "planned");
        for (const c of frame.contacts) drawForce(...px(c[0], c[1]), c[2], c[3], "contact");
        if (frame.wrench && gocf) {
          const [x, y] = px(gocf[0], gocf[1]);
          drawTorque(x, y, frame.wrench[2]);
          drawForce(x, y, frame.wrench[0], frame.wrench[1], "wrench");
        }
      }
      for (const c of frame.contacts) {
        const shape = kind(data.modes[c[4]]), [x, y] = px(c[0], c[1]);
        el("path", { class: `marker mode-${shape}`, d: MARKERS[shape], transform: `translate(${x.toFixed(2)} ${y.toFixed(2)})` }, over);
      }
    };
    return { draw };
  };

  // The displacement of ee against gocf, enlarged: the finger's elasticity sees just this.
  const createCompliance = (svg, data, trial) => {
    svg.replaceChildren();
    const cx = 130, cy = 96, half = 92;
    const offset = (ee, go) => ee && go ? between(compose(go, data.grasp), ee) : null;
    const every = (series) => (series?.ee || []).map((ee, i) => offset(ee, series.go?.[i])).filter(Boolean);
    const trail = every(trial.playback);
    const reach = Math.max(0.0005, ...[...trail, ...every(trial.waypoints?.planned)].map((x) => Math.max(Math.abs(x[0]), Math.abs(x[1]))));
    const step = nice(reach / 1.2), lines = Math.max(1, Math.ceil(reach / step)), scale = half / (lines * step);
    let grid = "";
    for (let i = -lines; i <= lines; i++) {
      const d = i * step * scale;
      grid += `M${cx + d} ${cy - half}V${cy + half}M${cx - half} ${cy + d}H${cx + half}`;
    }
    el("path", { class: "grid", d: grid }, svg);
    el("text", { class: "quiet", x: cx + half, y: cy + half + 16, "text-anchor": "end" }, svg).textContent = `grid ${+(step * 1000).toPrecision(3)} mm`;
    const points = trail.map((x) => `${(cx + scale * x[0]).toFixed(1)} ${(cy - scale * x[1]).toFixed(1)}`);
    el("path", { class: "trail", d: points.length ? "M" + points.join("L") : "" }, svg);
    el("path", { class: "axis-gocf", d: `M${cx + 34} ${cy}H${cx}V${cy - 34}` }, svg);
    el("text", { class: "quiet", x: cx + 37, y: cy + 4 }, svg).textContent = "gocf";
    const link = el("path", { class: "membrane" }, svg);
    const ghost = el("path", { class: "ghost", d: "M22 0H0V-22" }, svg);
    const ee = el("path", { class: "axis-ee", d: "M22 0H0V-22" }, svg);
    const name = el("text", { class: "halo" }, svg);
    name.textContent = "ee";
    const text = el("text", { x: cx, y: 228, "text-anchor": "middle", id: "offset" }, svg);

    const put = (node, x) => {
      show(node, Boolean(x));
      if (x) node.setAttribute("transform", `translate(${cx + scale * x[0]} ${cy - scale * x[1]}) rotate(${-x[2] * 180 / Math.PI})`);
    };
    const draw = (frame, planned, options) => {
      const x = offset(frame.ee, frame.go);
      put(ee, x);
      put(ghost, options.plan && planned ? offset(planned.ee, planned.go) : null);
      show(name, Boolean(x)); show(link, Boolean(x));
      if (!x) { text.textContent = "not recorded"; return; }
      const [ux, uy] = [cx + scale * x[0], cy - scale * x[1]];
      link.setAttribute("d", `M${cx} ${cy}L${ux} ${uy}`);
      name.setAttribute("x", ux - 16); name.setAttribute("y", uy + 15);
      text.textContent = `x ${number(x[0] * 1000, 2)} mm · y ${number(x[1] * 1000, 2)} mm · θ ${number(x[2] * 180 / Math.PI, 2)}°`;
    };
    return { draw };
  };

  return { create, createCompliance, wrap, number, kind, MARKERS, el };
})();
