"use strict";

// What every figure shares: the plotting library and the page's colours. The library is as large as it is useful, so it
// is started when a figure comes near the screen, or goes to paper.
const Plots = (() => {
  const CONFIG = { displaylogo: false, responsive: true, modeBarButtonsToRemove: ["select2d", "lasso2d", "autoScale2d"] };
  const SHADES = { recorded: "ink", loss: "measured", stiffness: "ink", interval: "fitted", cone: "fitted" };  // others have their own
  let started = false;

  const shade = (name) => getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
  const numbered = (layout, letter) => Object.keys(layout).filter((key) => new RegExp(`^${letter}axis\\d*$`).test(key));

  const start = () => {
    if (started) return;
    started = true;
    const script = document.createElement("script");
    script.textContent = document.getElementById("plotly").textContent;
    document.head.append(script);
  };

  const layout = (plain) => {
    const font = { family: getComputedStyle(document.body).fontFamily, size: 12, color: shade("ink") };
    const axis = {
      color: shade("muted"), gridcolor: shade("line"), linecolor: shade("line"),
      zeroline: false, showgrid: true, showline: true, ticks: "", nticks: 6,
    };
    const themed = {
      ...plain, font, paper_bgcolor: shade("page"), plot_bgcolor: shade("page"),
      hoverlabel: { bgcolor: shade("panel"), bordercolor: shade("line"), font },
      modebar: { bgcolor: "rgba(0,0,0,0)", color: shade("muted"), activecolor: shade("ink") },
    };
    for (const key of [...numbered(themed, "x"), ...numbered(themed, "y")]) themed[key] = { ...themed[key], ...axis };
    return themed;
  };

  const trace = (plain, looks) => {
    const { role } = plain.meta, look = looks[role], color = shade(SHADES[role] || role);
    const marker = { ...look.marker, color, line: { color, ...look.marker?.line } };
    return { ...look, ...plain, line: { ...look.line, color }, marker, ...(look.fill ? { fillcolor: color } : {}) };
  };

  const draw = (holder, data, themed, width) => {
    start();
    Plotly.react(holder, data, width ? { ...themed, width } : { ...themed, autosize: true }, CONFIG);
  };

  // Once, when the node comes near the screen.
  const whenNear = (node, action) => new IntersectionObserver((entries, observer) => {
    if (!entries.some((entry) => entry.isIntersecting)) return;
    observer.disconnect();
    action();
  }, { rootMargin: "300px" }).observe(node);

  // Colours follow the scheme, widths the paper.
  const follow = (redraw, toPaper) => {
    Theme.follow(redraw);
    addEventListener("beforeprint", toPaper);
    addEventListener("afterprint", redraw);
  };

  return { shade, numbered, layout, trace, draw, whenNear, follow };
})();
