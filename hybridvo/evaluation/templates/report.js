"use strict";
const root = document.documentElement;
document.getElementById("theme").addEventListener("click", () => {
  const dark = root.dataset.theme ? root.dataset.theme === "dark" : matchMedia("(prefers-color-scheme: dark)").matches;
  root.dataset.theme = dark ? "light" : "dark";
});
// legend: a button hides its method, or its source of flow, everywhere
for (const button of document.querySelectorAll("#legend button[data-hide]")) {
  button.addEventListener("click", () => {
    const hidden = document.body.classList.toggle("hide-" + button.dataset.hide);
    button.setAttribute("aria-pressed", String(!hidden));
  });
}
// tables: a click on a heading sorts, what is missing stays at the end
for (const button of document.querySelectorAll("th button")) {
  button.addEventListener("click", () => {
    const head = button.parentElement, table = head.closest("table"), body = table.tBodies[0];
    const up = head.getAttribute("aria-sort") !== "ascending";
    for (const other of table.querySelectorAll("th")) other.removeAttribute("aria-sort");
    head.setAttribute("aria-sort", up ? "ascending" : "descending");
    const value = row => row.cells[head.cellIndex].dataset.v ?? "";
    const numeric = !head.classList.contains("t");
    const rows = [...body.rows].sort((a, b) => {
      const x = value(a), y = value(b);
      if (x === "" || y === "") return (x === "") - (y === "");
      const order = numeric ? Number(x) - Number(y) : x.localeCompare(y);
      return up ? order : -order;
    });
    body.append(...rows);
  });
}
// 3-D views: drag, or arrow keys
function turn(view) {
  const a = Number(view.dataset.az), e = Number(view.dataset.el);
  const [ca, sa, ce, se] = [Math.cos(a), Math.sin(a), Math.cos(e), Math.sin(e)];
  for (const item of view.querySelectorAll("[data-p]")) {
    const p = item.dataset.p.split(" ").map(Number), shown = [];
    for (let i = 0; i < p.length; i += 3) {
      const side = ca * p[i] - sa * p[i + 2], away = sa * p[i] + ca * p[i + 2];
      shown.push(side.toFixed(1) + "," + (ce * p[i + 1] - se * away).toFixed(1));
    }
    if (item.tagName === "text") {
      const [u, v] = shown[0].split(",");
      item.setAttribute("x", u); item.setAttribute("y", v);
    } else item.setAttribute("points", shown.join(" "));
  }
}
function move(view, da, de) {
  view.dataset.az = Number(view.dataset.az) + da;
  view.dataset.el = Math.min(Math.PI / 2, Math.max(-0.2, Number(view.dataset.el) + de));
  turn(view);
}
for (const view of document.querySelectorAll(".view3d")) {
  let last = null;
  view.addEventListener("pointerdown", event => { last = [event.clientX, event.clientY]; view.setPointerCapture(event.pointerId); });
  view.addEventListener("pointermove", event => {
    if (last === null) return;
    move(view, (event.clientX - last[0]) * 0.01, (event.clientY - last[1]) * 0.01);
    last = [event.clientX, event.clientY];
  });
  for (const end of ["pointerup", "pointercancel"]) view.addEventListener(end, () => { last = null; });
  view.addEventListener("keydown", event => {
    const step = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1] }[event.key];
    if (step) { event.preventDefault(); move(view, ...step); }
  });
}
// a print has everything
let closed = [];
addEventListener("beforeprint", () => {
  closed = [...document.querySelectorAll("details:not([open])")];
  for (const part of closed) part.open = true;
});
addEventListener("afterprint", () => { for (const part of closed) part.open = false; });
root.dataset.ready = "yes";
