"use strict";

// The figures beside the traces: how plans were found, what was calibrated. Each is drawn when it comes near the screen.
(() => {
  const { figures, styles } = JSON.parse(document.getElementById("drawings").textContent);
  const PAPER = { wide: 680, narrow: 330 };  // whole and half the width between the margins of an A4 page [px]

  for (const holder of document.querySelectorAll("[data-figure]")) {
    const figure = figures[Number(holder.dataset.figure)];
    let drawn = false;
    const draw = (width) => {
      drawn = true;
      Plots.draw(holder, figure.data.map((trace) => Plots.trace(trace, styles)), Plots.layout(figure.layout), width);
    };
    Plots.whenNear(holder, () => { if (!drawn) draw(); });
    Plots.follow(() => { if (drawn) draw(); }, () => draw(figure.wide ? PAPER.wide : PAPER.narrow));
  }
})();
