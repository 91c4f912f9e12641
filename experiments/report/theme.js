"use strict";

// Light or dark: as the system has it, or as chosen here. The style sheet of the dark knows by its media; who draws with
// the page's colours listens to `follow`.
const Theme = (() => {
  const KEY = "extrinsic-report-theme";
  const MEDIA = { system: "screen and (prefers-color-scheme: dark)", light: "not all", dark: "screen" };
  const listeners = [];

  // A browser may forbid a page from a disk to remember anything.
  const remembered = () => { try { return localStorage.getItem(KEY); } catch { return null; } };
  const remember = (choice) => { try { localStorage.setItem(KEY, choice); } catch { /* it holds until the page is left */ } };

  const show = (choice) => {
    document.getElementById("dark").media = MEDIA[choice];
    document.documentElement.dataset.theme = choice;
  };
  const choose = (choice) => {
    show(choice);
    remember(choice);
    for (const listener of listeners) listener();
  };

  const before = remembered();
  show(Object.hasOwn(MEDIA, before) ? before : "system");
  for (const query of ["(prefers-color-scheme: dark)", "print"]) {
    matchMedia(query).addEventListener("change", () => { for (const listener of listeners) listener(); });
  }
  document.addEventListener("DOMContentLoaded", () => {
    const select = document.getElementById("theme");
    select.closest("[hidden]").hidden = false;
    select.value = document.documentElement.dataset.theme;
    select.addEventListener("change", () => choose(select.value));
  });
  return { choose, follow: (listener) => listeners.push(listener) };
})();
