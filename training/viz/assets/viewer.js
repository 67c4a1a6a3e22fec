// Source of viewer.bundle.js, which training/viz/viewer.py writes into every page. To rebuild (three 0.187.0, esbuild 0.28.2):
//   cd training/viz/assets && npm install && npm run build && rm -rf node_modules package-lock.json
// One WebGL context draws all panels, each through its own scissor rectangle: browsers allow only a few contexts a page.
import { DirectionalLight, HemisphereLight, PerspectiveCamera, Scene, Vector3, WebGLRenderer } from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";
import { data, find } from "./viewer.data.js";
import { bytes, clear, decode, discard, errorColors, ground, move, roleColors, shaded, surface } from "./viewer.meshes.js";
import { build, fit, make } from "./viewer.tiles.js";

let renderer;
let panels = [];
let current = 0;
let pending = false;
let touched = false; // until the reader turns something, a change of size sets the view anew

// What a panel shows of an example: mesh, colours, words below; nothing where a method or the truth is missing.
function content(panel, example) {
  if (panel.kind === "error") {
    const error = example.errors[panel.method];
    const mesh = example.outputs[panel.method];
    return error && { mesh, words: error.text, strength: 0.35, colors: errorColors(errorValues(error)) };
  }
  const mesh = panel.kind === "output" ? example.outputs[panel.method] : example[panel.kind];
  const words = panel.kind === "output" && data.methods.length > 1 ? example.metrics[panel.method] : mesh?.name;
  const look = find("look").checked ? mesh?.look : null;
  const color = look ? [1, 1, 1] : data.colors[panel.kind];
  return mesh && { mesh, words, look, strength: 0.8, colors: roleColors(color, bytes(mesh.openness).length) };
}

function errorValues(error) {
  return Float32Array.from(decode(error.levels, "uint16"), (level) => level * error.step);
}

function bodyOf(shown, mesh = shown.mesh) {
  return surface(mesh, shaded(shown.colors, decode(shown.mesh.openness, "uint8"), shown.strength), shown.look);
}

function refill(panel, example) {
  const shown = content(panel, example);
  clear(panel.scene);
  if (shown) panel.scene.add(bodyOf(shown), ground(shown.mesh));
  panel.element.querySelector(".name").textContent = shown ? shown.words : "none";
  panel.element.classList.toggle("best", panel.kind === "output" && panel.method === example.best);
}

function show(index) {
  const before = data.examples[current].view;
  current = (index + data.examples.length) % data.examples.length;
  const example = data.examples[current];
  const { leader } = panels;
  panels.leader = null; // each panel moves by itself here
  for (const panel of panels) refill(panel, example);
  if (touched) panels.forEach((panel) => carry(panel, before, example.view));
  else panels.forEach(home);
  panels.leader = leader;
  rank(example);
  find("caption").textContent = example.title;
  find("metrics").textContent = data.methods.length === 1 ? example.metrics[data.methods[0].name] ?? "" : "";
  find("choice").value = find("slider").value = String(current);
  find("count").textContent = `${current + 1} / ${data.examples.length}`;
  find("player").hidden = !example.motion || !renderer;
  if (example.motion) {
    find("frame").max = String(example.motion.output.length - 1);
    toFrame(Math.min(Number(find("frame").value), example.motion.output.length - 1));
  }
  redraw();
}

// A frame of the sequence in the panels that move; a mesh of other triangles takes the place of the one before.
function toFrame(number) {
  const example = data.examples[current];
  const { motion } = example;
  for (const panel of panels.filter(({ kind }) => motion[kind])) {
    const mesh = motion[panel.kind][number];
    const body = panel.scene.getObjectByName("body");
    if (!move(body, mesh)) {
      discard(panel.scene, body);
      const shown = content(panel, example); // the first frame, whose light and colours hold for its triangles alone
      const count = decode(mesh.positions, "uint16").length / 3;
      panel.scene.add(shown.mesh.faces === mesh.faces ? bodyOf(shown, mesh) : surface(mesh, roleColors(data.colors[panel.kind], count)));
    }
    panel.element.querySelector(".name").textContent = mesh.name;
    discard(panel.scene, panel.scene.getObjectByName("ground"));
    panel.scene.add(ground(mesh));
  }
  find("frame").value = String(number);
  find("time").textContent = `${number + 1} / ${motion.output.length}`;
  redraw();
}

let playing = null; // when the first frame was, in milliseconds

function play(wanted) {
  const { motion } = data.examples[current];
  playing = wanted && motion && renderer ? performance.now() - (1000 * Number(find("frame").value)) / motion.rate : null;
  find("play").textContent = playing === null ? "play" : "pause";
  if (playing !== null) requestAnimationFrame(tick);
}

function tick(now) {
  const { motion } = data.examples[current];
  if (playing === null || !motion) return;
  const number = Math.floor((Math.max(now - playing, 0) * motion.rate) / 1000) % motion.output.length;
  if (String(number) !== find("frame").value) toFrame(number);
  requestAnimationFrame(tick);
}

// Mean errors of an example as bars, the shortest in bold; all examples share one scale.
function rank(example) {
  const least = Math.min(...Object.values(example.errors).map((error) => error.mean));
  const all = data.examples.flatMap((one) => Object.values(one.errors).map((error) => error.mean));
  find("ranking").replaceChildren(...data.methods.filter(({ name }) => example.errors[name]).map(({ name, color }) => {
    const { mean } = example.errors[name];
    const row = make("li", mean === least && example.best ? "best" : "");
    const bar = make("i", "bar");
    bar.style.background = color;
    bar.style.width = `${Math.max((100 * mean) / Math.max(...all), 0.5)}%`;
    row.append(make("span", "label", name), make("span", "value", `${Number(mean.toPrecision(3))} ${data.error.unit}`), bar);
    return row;
  }));
}

function home(panel) {
  const { camera, controls } = panel;
  const { view } = data.examples[current];
  const slope = Math.tan((camera.fov * Math.PI) / 360) * 0.82;
  const distance = Math.max(view.height / slope, view.width / (slope * camera.aspect)) / 2 + view.depth / 2;
  controls.target.set(...view.center);
  camera.position.copy(controls.target).addScaledVector(new Vector3(...view.direction), distance);
  limits(panel, distance);
  controls.update();
}

function limits({ camera, controls }, distance) {
  camera.near = distance / 100;
  camera.far = distance * 20;
  controls.minDistance = distance / 20;
  controls.maxDistance = distance * 6;
  camera.updateProjectionMatrix();
}

// Where the reader has turned the view, another example is seen from there too, in its own size.
function carry(panel, before, after) {
  const { camera, controls } = panel;
  const ratio = Math.max(after.width, after.height) / Math.max(before.width, before.height, 1e-12);
  const offset = camera.position.clone().sub(controls.target).multiplyScalar(ratio);
  controls.target.sub(new Vector3(...before.center)).multiplyScalar(ratio).add(new Vector3(...after.center));
  limits(panel, (controls.minDistance * 20) * ratio);
  camera.position.copy(controls.target).add(offset);
  controls.update();
}

function follow(leader) {
  for (const panel of panels) {
    if (panel === leader) continue;
    panel.controls.target.copy(leader.controls.target);
    panel.camera.position.copy(leader.camera.position);
    panel.camera.quaternion.copy(leader.camera.quaternion);
  }
}

function addPanel(panel) {
  const { element } = panel;
  Object.assign(panel, { scene: new Scene(), camera: new PerspectiveCamera(18, 1, 0.1, 100) });
  panel.controls = new OrbitControls(panel.camera, element);
  panel.controls.addEventListener("start", () => { touched = true; panels.leader = panel; });
  panel.controls.addEventListener("change", () => {
    if (panels.leader === panel && find("together").checked) follow(panel);
    redraw();
  });
  const key = new DirectionalLight(0xffffff, 2.5);
  key.position.set(-0.5, 0.62, 0.6);
  const fill = new DirectionalLight(0xdfe8ff, 0.55);
  fill.position.set(0.85, 0.05, 0.5);
  panel.camera.add(key, fill); // the light stays at the viewer's shoulder
  panel.scene.add(panel.camera, new HemisphereLight(0xffffff, 0xa9a6a2, 1.25));
}

function redraw() {
  if (pending || !renderer) return;
  pending = true;
  requestAnimationFrame(() => {
    pending = false;
    draw();
  });
}

function draw() {
  const page = renderer.domElement.getBoundingClientRect();
  renderer.setScissorTest(false);
  renderer.clear();
  renderer.setScissorTest(true);
  for (const panel of panels) {
    const box = panel.element.getBoundingClientRect();
    if (!box.width) continue; // hidden
    const rectangle = [box.left - page.left, page.bottom - box.bottom, box.width, box.height];
    renderer.setViewport(...rectangle);
    renderer.setScissor(...rectangle);
    renderer.render(panel.scene, panel.camera);
  }
}

function resize() {
  if (!renderer) return;
  fit();
  const grid = find("grid");
  renderer.setPixelRatio(Math.min(window.devicePixelRatio || 1, 2));
  renderer.setSize(grid.clientWidth, grid.clientHeight, false);
  for (const panel of panels.filter(({ element }) => element.clientWidth)) {
    panel.camera.aspect = panel.element.clientWidth / Math.max(panel.element.clientHeight, 1);
    panel.camera.updateProjectionMatrix();
    if (!touched) home(panel);
  }
  draw(); // at once: a canvas is blank after a change of size
}

function reset() {
  touched = false;
  panels.leader = null;
  panels.forEach(home);
  redraw();
}

function listen() {
  find("previous").addEventListener("click", () => show(current - 1));
  find("next").addEventListener("click", () => show(current + 1));
  find("slider").addEventListener("input", (event) => show(Number(event.target.value)));
  find("choice").addEventListener("change", (event) => show(Number(event.target.value)));
  find("reset").addEventListener("click", reset);
  find("together").addEventListener("change", (event) => {
    if (event.target.checked && panels.leader) follow(panels.leader);
    redraw();
  });
  find("wireframe").addEventListener("change", (event) => {
    panels.forEach((panel) => { const wire = panel.scene.getObjectByName("wireframe"); if (wire) wire.visible = event.target.checked; });
    redraw();
  });
  find("look").addEventListener("change", () => show(current));
  find("play").addEventListener("click", () => play(playing === null));
  find("frame").addEventListener("input", (event) => {
    play(false);
    toFrame(Number(event.target.value));
  });
  window.addEventListener("painted", redraw);
  document.addEventListener("keydown", (event) => {
    if (["INPUT", "SELECT"].includes(event.target.tagName) && event.target.type !== "checkbox") return;
    if (event.key === "ArrowLeft") show(current - 1);
    else if (event.key === "ArrowRight") show(current + 1);
  });
  new ResizeObserver(resize).observe(find("grid"));
  window.addEventListener("resize", resize);
}

function fill() {
  data.examples.forEach((example, index) => find("choice").add(new Option(`${index + 1}. ${example.title}`, String(index))));
  find("slider").max = String(data.examples.length - 1);
  const stops = data.error.colors.filter((_, index) => index % 15 === 0).map((color) => `rgb(${color})`);
  find("bar").style.background = `linear-gradient(to right, ${stops})`;
  const label = (share) => Number((share * data.error.limit).toPrecision(2)).toString();
  find("ticks").replaceChildren(...[0, 0.5, 1].map((share) => {
    const tick = document.createElement("span");
    tick.textContent = label(share) + (share === 1 ? "+" : "");
    return tick;
  }));
  find("unit").textContent = `per-vertex error (${data.error.unit})`;
  for (const element of document.querySelectorAll(".single")) element.hidden = data.examples.length < 2;
  find("look").parentElement.hidden = !Object.keys(data.looks).length;
}

function start() {
  fill();
  panels = build(resize);
  try {
    renderer = new WebGLRenderer({ antialias: true, alpha: true });
    renderer.autoClear = false;
    renderer.domElement.setAttribute("aria-hidden", "true");
    renderer.domElement.addEventListener("webglcontextrestored", redraw);
    find("grid").append(renderer.domElement);
    panels.forEach(addPanel);
  } catch (reason) { // titles and numbers can still be read
    console.warn(reason);
    panels = [];
    document.querySelectorAll(".drawn").forEach((element) => { element.hidden = true; });
    find("message").hidden = false;
  }
  listen();
  show(0);
  resize();
  play(true);
  window.viewer = { panels, show, toFrame, play }; // for tests and for the curious
}

start();
