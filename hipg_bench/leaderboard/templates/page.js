"use strict";
// the theme: the reader's system decides until the button is pressed
document.getElementById("theme").addEventListener("click", () => {
  const root = document.documentElement;
  const dark = root.dataset.theme ? root.dataset.theme === "dark" : matchMedia("(prefers-color-scheme: dark)").matches;
  root.dataset.theme = dark ? "light" : "dark";
  try { localStorage.setItem("theme", root.dataset.theme); } catch { /* it holds for this page only */ }
});

// tables: a click on a column sorts by it, a second one turns the order
const value = (row, key) => {
  const text = row.dataset[key];
  return text === "" || Number.isNaN(Number(text)) ? text : Number(text);
};
for (const button of document.querySelectorAll("th button[data-sort]")) {
  button.addEventListener("click", () => {
    const head = button.closest("th"), body = head.closest("table").tBodies[0], key = button.dataset.sort;
    const first = ["name", "rank", "deaths"].includes(key) ? "ascending" : "descending";
    const turned = first === "ascending" ? "descending" : "ascending";
    const order = head.getAttribute("aria-sort") === first ? turned : first;
    for (const other of head.parentElement.children) other.removeAttribute("aria-sort");
    head.setAttribute("aria-sort", order);
    const sign = order === "ascending" ? 1 : -1;
    body.append(...[...body.rows].sort((a, b) => {
      const x = value(a, key), y = value(b, key);
      return sign * (typeof x === "string" ? x.localeCompare(y) : x - y);
    }));
  });
}

// filters: which table is seen, and which of its rows
const form = document.getElementById("filters");
if (form) {
  const show = () => {
    const wanted = new FormData(form);
    let seen = 0;
    for (const panel of document.querySelectorAll(".panel")) {
      panel.hidden = panel.dataset.split !== wanted.get("split") || panel.dataset.family !== wanted.get("family");
      for (const table of panel.querySelectorAll("table")) {
        let rows = 0;
        for (const row of table.tBodies[0].rows) {
          const keys = ["status", "tier", "kind", "execution"];
          const name = wanted.get("name").trim().toLowerCase();
          row.hidden = !keys.every((key) => !wanted.get(key) || row.dataset[key] === wanted.get(key)) || !row.dataset.name.includes(name);
          rows += !row.hidden;
        }
        table.parentElement.hidden = rows === 0;
        seen += panel.hidden ? 0 : rows;
      }
    }
    for (const part of document.querySelectorAll(".by-split")) part.hidden = part.dataset.split !== wanted.get("split");
    document.getElementById("none").hidden = seen > 0;
  };
  form.addEventListener("input", show);
  form.addEventListener("submit", (event) => event.preventDefault());
  show();
}

// films: all of them at once, in step
const playAll = document.getElementById("play-all");
if (playAll) {
  const films = [...document.querySelectorAll(".films video")];
  const playing = () => films.some((film) => !film.paused && !film.ended);
  const say = () => {
    playAll.textContent = playing() ? "Pause all" : "Play all";
    playAll.setAttribute("aria-pressed", String(playing()));
  };
  playAll.addEventListener("click", () => {
    if (playing()) { films.forEach((film) => film.pause()); return; }
    const at = films.every((film) => film.ended) ? 0 : Math.min(...films.map((film) => film.currentTime));
    films.forEach((film) => { film.currentTime = at; film.play().catch(() => {}); });
  });
  document.getElementById("restart").addEventListener("click", () => films.forEach((film) => { film.currentTime = 0; }));
  for (const film of films) for (const event of ["play", "pause", "ended"]) film.addEventListener(event, say);
}
