"use strict";

// Trials as points, with mean and interval, row by row: a row for each method of each cell, a column for each error.
(() => {
  const figures = JSON.parse(document.getElementById("data").textContent);
  const PAPER = 680;  // width between the margins of an A4 page [px]
  const COLUMN_GAP = 0.04, MARGIN = 0.04;
  const drawn = new Map();

  // Plotly takes tags for its own.
  const plain = (text) => text.replace(/&/g, "&amp;").replace(/</g, "&lt;").replace(/>/g, "&gt;");
  // A cell's name beside the figure, in lines of a few values where it is long; the whole of it stands in the table.
  const label = (name) => {
    const lines = [];
    for (const part of name.split(" · ")) {
      const joined = lines.length ? `${lines.at(-1)} · ${part}` : part;
      if (lines.length && joined.length <= 24) lines[lines.length - 1] = joined; else lines.push(part);
    }
    return lines.map((line) => plain(line.length > 34 ? `${line.slice(0, 33)}…` : line)).join("<br>");
  };
  const chosen = (name) => document.querySelector(`input[name="source-${name}"]:checked`)?.value;

  // Where each row of a page stands, from the top, in rows; and where each cell does, with a row for its name if need be.
  const places = (page, size, named) => {
    const rows = [], cells = [];
    let y = 0;
    for (const group of page.groups) {
      if (!cells.length || cells.at(-1).name !== group.cell) {
        if (cells.length) y += size.gap / size.row;
        cells.push({ name: group.cell, from: y, to: y });
        if (named) y += 1;
      }
      rows.push(y + 0.5);
      y += 1;
      cells.at(-1).to = y;
    }
    return { rows, cells, end: y };
  };

  // Limits of an error over all pages, so that pages can be compared.
  const limits = (figure, source, key) => {
    let low = 0, high = 0;
    for (const { groups } of figure.pages) for (const { values, means } of groups) {
      for (const value of [...(values[source]?.[key] || []), ...(means[source]?.[key] || []).slice(0, 3)]) {
        if (value === null) continue;
        if (value < low) low = value;
        if (value > high) high = value;
      }
    }
    const room = MARGIN * (high - low || 1);
    return [figure.zero ? low - room : -room / 2, high + room];  // no error is below zero, whatever its interval says
  };

  const axes = (index) => (index ? { xaxis: `x${index + 1}`, yaxis: `y${index + 1}` } : { xaxis: "x", yaxis: "y" });

  const hover = (unit) => `%{text}<br>%{x:.3f} ${unit}<extra></extra>`;

  // The trials of one method in one column: those that completed and those that did not, then their means.
  const traces = (figure, page, rows, source, series, index) => {
    const { key, unit } = figure.quantities[index];
    const at = { ...axes(index), legendgroup: series.name, meta: { role: series.color } };
    const points = { done: { x: [], y: [], text: [], customdata: [] }, short: { x: [], y: [], text: [], customdata: [] } };
    const means = { x: [], y: [], text: [], plus: [], minus: [] };
    page.groups.forEach((group, row) => {
      if (group.series !== series.name) return;
      const values = group.values[source][key], count = values.length;
      values.forEach((value, n) => {
        if (value === null) return;
        const into = group.done[n] ? points.done : points.short;
        into.x.push(value);
        into.y.push(rows[row] + (count > 1 ? (n / (count - 1) - 0.5) * 0.62 : 0));
        into.text.push(plain(group.names[n]));
        into.customdata.push(group.links[n]);
      });
      const mean = group.means[source][key];
      if (!mean) return;
      const [middle, low, high, n] = mean;
      means.x.push(middle);
      means.y.push(rows[row]);
      means.text.push(plain(`mean of ${n}: ${series.name}`));
      means.plus.push(high === null ? 0 : high - middle);
      means.minus.push(low === null ? 0 : middle - low);
    });
    const dots = { type: "scatter", mode: "markers", showlegend: false, hovertemplate: hover(unit) };
    const styled = (looks, trace) => Plots.trace({ ...dots, ...at, ...trace }, { [series.color]: looks });
    const mean = styled({ marker: { size: 10, symbol: "diamond", line: { width: 1.5, color: Plots.shade("page") } } }, {
      x: means.x, y: means.y, text: means.text, name: plain(series.name), showlegend: false,
      error_x: { type: "data", symmetric: false, array: means.plus, arrayminus: means.minus, thickness: 2, width: 5 },
    });
    mean.error_x.color = mean.marker.color;
    return [
      styled({ marker: { size: 7, symbol: series.symbol, opacity: 0.5 } }, { ...points.done, name: plain(series.name) }),
      styled({ marker: { size: 7, symbol: "x-thin", line: { width: 1.75 } } }, { ...points.short, name: plain(series.name) }),
      mean,
      // the legend has a mark of its own, so that a method is in it whatever its trials came to
      ...(index ? [] : [styled({ marker: { size: 9, symbol: series.symbol } }, { x: [null], y: [null], name: plain(series.name), showlegend: true })]),
    ];
  };

  const figureOf = (name, number) => {
    const figure = figures[name], page = figure.pages[number], source = chosen(name) || figure.sources[0];
    const { rows, cells, end } = places(page, figure.size, figure.named), { top, bottom } = figure.size;
    const count = figure.quantities.length, width = (1 - COLUMN_GAP * (count - 1)) / count;
    const ticks = figure.named
      ? { tickvals: rows, ticktext: page.groups.map((group) => label(group.series)) }
      : { tickvals: cells.map(({ from, to }) => (from + to) / 2), ticktext: cells.map((cell) => label(cell.name)) };
    const half = figure.size.gap / figure.size.row / 2;
    const layout = {
      height: page.height, margin: { l: 10, r: 10, t: top, b: bottom }, hovermode: "closest", dragmode: "zoom",
      showlegend: !figure.named, legend: { orientation: "h", x: 0, y: 1, yanchor: "top", yref: "container" }, annotations: [], shapes: [],
    };
    figure.quantities.forEach(({ key, head, unit }, i) => {
      const id = i ? String(i + 1) : "", across = [i * (width + COLUMN_GAP), i * (width + COLUMN_GAP) + width];
      layout[`xaxis${id}`] = { domain: across, anchor: `y${id}`, range: limits(figure, source, key) };
      layout[`yaxis${id}`] = {
        anchor: `x${id}`, range: [end + half, -half], ...(i ? { matches: "y" } : {}), showticklabels: i === 0, automargin: true,
        tickmode: "array", ...ticks, fixedrange: true,
      };
      layout.annotations.push({
        text: `${head} [${unit}]`, x: across[0], y: 1, xref: "paper", yref: "paper", xanchor: "left", yanchor: "bottom",
        yshift: 4, showarrow: false, font: { size: 12 },
      });
      cells.forEach(({ from, to }, n) => n % 2 || layout.shapes.push({
        type: "rect", layer: "below", xref: `x${id} domain`, yref: `y${id}`, x0: 0, x1: 1, y0: from - half, y1: to + half,
        line: { width: 0 }, fillcolor: Plots.shade("panel"),
      }));
      if (figure.zero) layout.shapes.push({
        type: "line", xref: `x${id}`, yref: `y${id} domain`, x0: 0, x1: 0, y0: 0, y1: 1, line: { width: 1, color: Plots.shade("ink") },
      });
    });
    if (figure.keys) layout.annotations.push({
      text: plain(figure.keys), x: 0, y: 0, xref: "paper", yref: "paper", xanchor: "left", yanchor: "top", yshift: -24, showarrow: false,
      font: { size: 12 },
    });
    if (figure.named) for (const { name, from } of cells) layout.annotations.push({
      text: plain(name), x: 0, y: from + 0.5, xref: "paper", yref: "y", xanchor: "left", yanchor: "middle", showarrow: false,
      font: { size: 12, weight: 600 },
    });
    const themed = Plots.layout(layout);
    for (const key of Plots.numbered(themed, "y")) Object.assign(themed[key], { showgrid: false, showline: false });
    const series = figure.series.filter((one) => page.groups.some((group) => group.series === one.name));
    const data = series.flatMap((one) => figure.quantities.flatMap((_, i) => traces(figure, page, rows, source, one, i)));
    return { data, layout: themed };
  };

  const draw = (holder, width) => {
    const { data, layout } = figureOf(holder.dataset.figure, Number(holder.dataset.page));
    Plots.draw(holder, data, layout, width);
    if (drawn.has(holder)) return;
    drawn.set(holder, true);
    holder.on("plotly_click", ({ points: [point] }) => { if (point.customdata) location.assign(point.customdata); });
  };
  const redraw = () => { for (const holder of drawn.keys()) draw(holder); };

  const holders = [...document.querySelectorAll(".trials-plot")];
  for (const holder of holders) Plots.whenNear(holder, () => draw(holder));
  for (const choice of document.querySelectorAll(".views input")) choice.addEventListener("change", redraw);
  Plots.follow(redraw, () => { for (const holder of holders) draw(holder, PAPER); });
})();
