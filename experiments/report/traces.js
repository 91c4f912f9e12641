"use strict";

// The traces of the chosen trial: coloured by the page's style, a cursor at the time of the playback.
(() => {
  const holder = document.getElementById("traces"), nothing = document.getElementById("no-traces");
  const PAPER = 680;  // width between the margins of an A4 page [px]
  const cursors = [];
  let near = false, drawn = false;

  const figureNow = () => Player.data.figures[Player.index];
  const deviating = () => document.querySelector("input[name=view]:checked")?.value === "deviation";

  // What a trace shows, from the data that the scene uses too: values as they are, or less the plan's.
  const points = ({ role, series, component, factor }, deviation) => {
    const { waypoints, playback } = Player.data.trials[Player.index];
    const values = (rows) => (rows || []).map((row) => row ? row[component] * factor : null);
    if (role === "recorded") {
      return deviation || !playback?.recorded ? { x: [], y: [] } : { x: playback.t, y: values(playback[series]) };
    }
    const y = values(waypoints[role][series]);
    if (!deviation) return { x: waypoints.t, y };
    const planned = values(waypoints.planned?.[series]);
    return { x: waypoints.t, y: y.map((value, k) => value === null || planned[k] == null ? null : value - planned[k]) };
  };

  const styled = (figure) => {
    const deviation = deviating();
    const layout = { ...Plots.layout(figure.layout), uirevision: `${Player.index} ${deviation}` };
    const data = figure.data.map((trace) => ({ ...Plots.trace(trace, Player.data.styles), ...points(trace.meta, deviation) }));
    for (const key of deviation ? Plots.numbered(layout, "y") : []) {
      const [low, high] = layout[key].range, id = key.replace("axis", "");
      const values = data.filter((t) => (t.yaxis || "y") === id).flatMap((t) => t.y).filter((v) => v !== null);
      const reach = 1.15 * Math.max(...values.map(Math.abs), (high - low) * 1e-4);
      layout[key].range = [-reach, reach];
    }
    return { data, layout };
  };

  const draw = (width) => {
    const figure = figureNow();
    nothing.hidden = Boolean(figure);
    holder.hidden = !figure;
    if (!figure) return;
    const { data, layout } = styled(figure);
    Plots.draw(holder, data, layout, width);
    if (!drawn) {
      drawn = true;
      holder.on("plotly_click", (event) => Player.seek(event.points[0].x));
      holder.on("plotly_hover", (event) => Player.preview(event.points[0].x));
      holder.on("plotly_unhover", () => Player.release());
      holder.on("plotly_relayout", moveCursors);
    }
    moveCursors();
  };
  const redraw = () => { if (drawn) draw(); };

  const moveCursors = () => {
    if (!drawn || holder.hidden) return;
    const layout = holder.layout, { l, r, t, b } = layout.margin, [from, to] = layout.xaxis.range.map(Number);
    const inner = (layout.width || holder.clientWidth) - l - r, share = (Player.time - from) / (to - from);
    const tall = layout.height - t - b, count = Plots.numbered(layout, "x").length;
    Plots.numbered(layout, "x").forEach((name, i) => {
      const [start, end] = layout[name].domain, [low, high] = layout[name.replace("x", "y")].domain;
      cursors[i] ||= holder.appendChild(Object.assign(document.createElement("div"), { className: "cursor" }));
      Object.assign(cursors[i].style, {
        left: `${l + inner * (start + share * (end - start))}px`, top: `${t + tall * (1 - high)}px`,
        height: `${tall * (high - low)}px`,
      });
    });
    cursors.forEach((cursor, i) => { cursor.hidden = !(share >= 0 && share <= 1 && i < count); });
  };

  Player.on("time", moveCursors);
  Player.on("trial", () => { if (near) draw(); });
  for (const choice of document.querySelectorAll("input[name=view]")) choice.addEventListener("change", redraw);
  addEventListener("resize", () => requestAnimationFrame(moveCursors));
  Plots.follow(redraw, () => draw(PAPER));
  Plots.whenNear(document.getElementById("traces-title"), () => {
    near = true;
    if (!drawn) draw();
  });
})();
