"use strict";

// The traces of the chosen trial: coloured by the page's style, a cursor at the time of the playback. The plotting
// library is as large as it is useful, so it is started when the traces come near the screen, or go to paper.
(() => {
  const holder = document.getElementById("traces"), nothing = document.getElementById("no-traces");
  const CONFIG = { displaylogo: false, responsive: true, modeBarButtonsToRemove: ["select2d", "lasso2d", "autoScale2d"] };
  const PAPER = 680;  // width between the margins of an A4 page [px]
  const cursors = [];
  let started = false, near = false, drawn = false;

  const figureNow = () => Player.data.figures[Player.index];
  const deviating = () => document.querySelector("input[name=view]:checked")?.value === "deviation";
  const numbered = (layout, letter) => Object.keys(layout).filter((key) => new RegExp(`^${letter}axis\\d*$`).test(key));

  const start = () => {
    if (started) return;
    started = true;
    const script = document.createElement("script");
    script.textContent = document.getElementById("plotly").textContent;
    document.head.append(script);
  };

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
    const css = getComputedStyle(document.documentElement), shade = (name) => css.getPropertyValue(`--${name}`).trim();
    const roles = { planned: shade("planned"), measured: shade("measured"), truth: shade("truth"), recorded: shade("ink") };
    const font = { family: getComputedStyle(document.body).fontFamily, size: 12, color: shade("ink") };
    const axis = {
      color: shade("muted"), gridcolor: shade("line"), linecolor: shade("line"),
      zeroline: false, showgrid: true, showline: true, ticks: "", nticks: 6,
    };
    const deviation = deviating(), layout = {
      ...figure.layout, font, paper_bgcolor: shade("page"), plot_bgcolor: shade("page"),
      hoverlabel: { bgcolor: shade("panel"), bordercolor: shade("line"), font },
      modebar: { bgcolor: "rgba(0,0,0,0)", color: shade("muted"), activecolor: shade("ink") },
      uirevision: `${Player.index} ${deviation}`,
    };
    const data = figure.data.map((trace) => {
      const color = roles[trace.meta.role], look = Player.data.styles[trace.meta.role];
      return { ...look, ...trace, ...points(trace.meta, deviation), line: { ...look.line, color }, marker: { ...look.marker, color } };
    });
    for (const key of numbered(layout, "x")) layout[key] = { ...layout[key], ...axis };
    for (const key of numbered(layout, "y")) {
      layout[key] = { ...layout[key], ...axis };
      if (!deviation) continue;
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
    start();
    const { data, layout } = styled(figure);
    Plotly.react(holder, data, width ? { ...layout, width } : { ...layout, autosize: true }, CONFIG);
    if (!drawn) {
      drawn = true;
      holder.on("plotly_click", (event) => Player.seek(event.points[0].x));
      holder.on("plotly_relayout", moveCursors);
    }
    moveCursors();
  };
  const redraw = () => { if (drawn) draw(); };

  const moveCursors = () => {
    if (!drawn || holder.hidden) return;
    const layout = holder.layout, { l, r, t, b } = layout.margin, [from, to] = layout.xaxis.range.map(Number);
    const inner = (layout.width || holder.clientWidth) - l - r, share = (Player.time - from) / (to - from);
    const tall = layout.height - t - b, count = numbered(layout, "x").length;
    numbered(layout, "x").forEach((name, i) => {
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
  for (const query of ["(prefers-color-scheme: dark)", "print"]) matchMedia(query).addEventListener("change", redraw);
  addEventListener("resize", () => requestAnimationFrame(moveCursors));
  addEventListener("beforeprint", () => draw(PAPER));
  addEventListener("afterprint", redraw);
  new IntersectionObserver((entries, observer) => {
    if (!entries.some((entry) => entry.isIntersecting)) return;
    observer.disconnect();
    near = true;
    if (!drawn) draw();
  }, { rootMargin: "300px" }).observe(document.getElementById("traces-title"));
})();
