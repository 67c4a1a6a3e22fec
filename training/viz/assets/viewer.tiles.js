// Where the panels of the page stand, and what is written on them.
import { data, errors, find, stacked } from "./viewer.data.js";

export function make(tag, name, words = "") {
  const element = document.createElement(tag);
  element.className = name;
  element.textContent = words;
  return element;
}

// Tiles from left to right, each with its panels from top to bottom.
function tiles() {
  const one = (kind, method = "") => ({ kind, method });
  const outputs = data.methods.map(({ name }) => (stacked ? [one("output", name), one("error", name)] : [one("output", name)]));
  const truth = data.examples.some((example) => example.truth) ? [[one("truth")]] : [];
  if (stacked) return [[one("source"), one("target")], ...outputs, ...truth];
  return [[one("source")], [one("target")], ...outputs, ...truth, ...(errors ? [[one("error", data.methods[0].name)]] : [])];
}

const WORDS = { source: ["Source", "pose"], target: ["Target", "identity"], truth: ["Ground truth", ""], error: ["Error", ""] };

function heading({ kind, method }) {
  const [words, small] = WORDS[kind] ?? [data.methods.length > 1 ? method : "Output", ""];
  const title = make("h2", "", words);
  const dot = make("i", "dot");
  dot.style.background = data.methods.find(({ name }) => name === method)?.color;
  if (kind === "output" && data.methods.length > 1) title.prepend(dot);
  title.append(make("small", "", small), make("small", "tag", "least PMD"));
  return title;
}

export function build(resize) {
  const panels = [];
  for (const specs of tiles()) {
    const tile = make("div", "tile");
    for (const spec of specs) {
      const element = make("section", "panel");
      element.append(heading(spec), make("p", "name"));
      tile.append(element);
      panels.push({ ...spec, element, tile });
    }
    if (stacked && specs[0].kind === "truth") tile.append(find("numbers"));
    find("grid").append(tile);
  }
  find("numbers").hidden = !errors;
  for (const { name, color } of data.methods.length > 1 ? data.methods : []) find("methods").append(chip(name, color, panels, resize));
  return panels;
}

function chip(name, color, panels, resize) {
  const label = make("label", "chip");
  const box = document.createElement("input");
  Object.assign(box, { type: "checkbox", checked: true });
  box.style.accentColor = color;
  box.addEventListener("change", () => {
    for (const panel of panels.filter(({ method }) => method === name)) panel.tile.hidden = !box.checked;
    resize();
  });
  label.append(box, name);
  return label;
}

// As many tiles abreast as have room, lines of equal length, and panels as high as the window allows.
export function fit() {
  const grid = find("grid");
  const shown = [...grid.querySelectorAll(".tile:not([hidden])")].length;
  const gap = 8;
  const abreast = Math.max(Math.floor((grid.clientWidth + gap) / (168 + gap)), 1);
  const lines = Math.ceil(shown / abreast);
  const columns = Math.ceil(shown / lines);
  const width = (grid.clientWidth - gap * (columns - 1)) / columns;
  const room = window.innerHeight - grid.getBoundingClientRect().top - window.scrollY - document.querySelector("footer").offsetHeight;
  const height = lines === 1 ? Math.min(stacked ? (room - gap) / 2 : room, 1.6 * width) : 1.1 * width;
  grid.style.gridTemplateColumns = `repeat(${columns}, minmax(0, 1fr))`;
  grid.style.setProperty("--panel-height", `${Math.round(Math.max(height, 200))}px`);
}
