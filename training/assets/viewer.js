// Source of viewer.bundle.js, which training/viewer.py writes into every page. To rebuild (three 0.187.0, esbuild 0.28.2):
//   cd training/assets && npm install && npm run build && rm -rf node_modules package-lock.json
// One WebGL context draws all panels, each through its own scissor rectangle: browsers allow only a few contexts a page.
import {
  BufferAttribute, BufferGeometry, Color, DataTexture, DirectionalLight, DoubleSide, HemisphereLight, LinearFilter, Mesh,
  MeshBasicMaterial, MeshStandardMaterial, PerspectiveCamera, PlaneGeometry, RGBAFormat, Scene, SRGBColorSpace, Vector3,
  WebGLRenderer,
} from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";

const data = JSON.parse(document.getElementById("data").textContent);
const find = (id) => document.getElementById(id);
const faceCache = new Map();
let renderer;
let panels = [];
let current = 0;
let pending = false;
let touched = false; // until the reader turns something, a change of size sets the view anew

function bytes(base64) {
  return Uint8Array.from(atob(base64), (letter) => letter.charCodeAt(0));
}

// Little-endian whatever the machine, as written.
function decode(base64, kind) {
  const raw = bytes(base64);
  const view = new DataView(raw.buffer);
  const [Kind, size, read] = {
    uint8: [Uint8Array, 1, "getUint8"],
    uint16: [Uint16Array, 2, "getUint16"],
    uint32: [Uint32Array, 4, "getUint32"],
    float32: [Float32Array, 4, "getFloat32"],
  }[kind];
  return Kind.from({ length: raw.length / size }, (_, index) => view[read](index * size, true));
}

function positions(mesh) {
  return Float32Array.from(decode(mesh.positions, "uint16"), (level, index) => mesh.low[index % 3] + level * mesh.step[index % 3]);
}

function faces(key) {
  if (!faceCache.has(key)) faceCache.set(key, new BufferAttribute(decode(data.faces[key].indices, data.faces[key].kind), 1));
  return faceCache.get(key);
}

function roleColors(color, count) {
  const linear = new Color().setRGB(...color, SRGBColorSpace);
  return Float32Array.from({ length: 3 * count }, (_, index) => [linear.r, linear.g, linear.b][index % 3]);
}

function errorColors(errors) {
  const map = data.error.colors.map((color) => new Color().setRGB(...color.map((level) => level / 255), SRGBColorSpace));
  const result = new Float32Array(3 * errors.length);
  errors.forEach((error, index) => {
    const level = Math.min(Math.round((255 * error) / data.error.limit), 255);
    map[level].toArray(result, 3 * index);
  });
  return result;
}

function shaded(colors, openness, strength) {
  return colors.map((value, index) => value * (1 - strength * (1 - openness[Math.floor(index / 3)] / 255)));
}

function surface(mesh, colors) {
  const geometry = new BufferGeometry();
  geometry.setAttribute("position", new BufferAttribute(positions(mesh), 3));
  geometry.setAttribute("color", new BufferAttribute(colors, 3));
  geometry.setIndex(faces(mesh.faces).clone());
  geometry.computeVertexNormals();
  const material = new MeshStandardMaterial({
    vertexColors: true, side: DoubleSide, roughness: 0.62, metalness: 0, polygonOffset: true, polygonOffsetFactor: 1, polygonOffsetUnits: 1,
  });
  const body = new Mesh(geometry, material);
  const wires = new MeshBasicMaterial({ color: 0x10151d, wireframe: true, transparent: true, opacity: 0.38 });
  const wire = new Mesh(geometry, wires);
  wire.name = "wireframe";
  wire.visible = find("wireframe").checked;
  body.add(wire);
  return body;
}

function ground(mesh) {
  const darkness = bytes(mesh.ground.shadow);
  const side = Math.round(Math.sqrt(darkness.length));
  const pixels = new Uint8Array(4 * darkness.length);
  darkness.forEach((level, index) => { pixels[4 * index + 3] = 0.7 * level; });
  const texture = new DataTexture(pixels, side, side, RGBAFormat);
  texture.magFilter = texture.minFilter = LinearFilter;
  texture.needsUpdate = true;
  const plane = new PlaneGeometry(mesh.ground.side, mesh.ground.side).rotateX(Math.PI / 2); // rows of the texture along +Z
  const shadow = new Mesh(plane, new MeshBasicMaterial({ map: texture, transparent: true, depthWrite: false, side: DoubleSide }));
  shadow.position.set(mesh.ground.corner[0] + mesh.ground.side / 2, mesh.low[1], mesh.ground.corner[1] + mesh.ground.side / 2);
  shadow.renderOrder = -1;
  return shadow;
}

function clear(scene) {
  for (const child of [...scene.children].filter((one) => one.isMesh)) {
    scene.remove(child);
    child.traverse((one) => { one.geometry.dispose(); one.material.map?.dispose(); one.material.dispose(); });
  }
}

function show(index) {
  current = (index + data.examples.length) % data.examples.length;
  const example = data.examples[current];
  for (const panel of panels) {
    const mesh = example.meshes[panel.role === "error" ? "output" : panel.role];
    const openness = decode(mesh.openness, "uint8");
    const heat = panel.role === "error";
    const colors = heat ? errorColors(decode(example.errors, "float32")) : roleColors(data.colors[panel.role], openness.length);
    clear(panel.scene);
    panel.scene.add(surface(mesh, shaded(colors, openness, heat ? 0.35 : 0.8)), ground(mesh));
    panel.element.querySelector(".name").textContent = heat ? example.error_text : mesh.name;
  }
  find("caption").textContent = example.title;
  find("metrics").textContent = example.metrics;
  find("choice").value = find("slider").value = String(current);
  find("count").textContent = `${current + 1} / ${data.examples.length}`;
  redraw();
}

function home(panel) {
  const { camera, controls } = panel;
  const direction = new Vector3(...data.view.direction);
  const slope = Math.tan((camera.fov * Math.PI) / 360) * 0.88;
  const distance = Math.max(data.view.height / slope, data.view.width / (slope * camera.aspect)) / 2 + data.view.depth / 2;
  controls.target.set(...data.view.center);
  camera.position.copy(controls.target).addScaledVector(direction, distance);
  camera.near = distance / 100;
  camera.far = distance * 20;
  controls.minDistance = distance / 20;
  controls.maxDistance = distance * 6;
  camera.updateProjectionMatrix();
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

function addPanel(element) {
  const panel = { element, role: element.dataset.role, scene: new Scene(), camera: new PerspectiveCamera(18, 1, 0.1, 100) };
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
  return panel;
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
    const rectangle = [box.left - page.left, page.bottom - box.bottom, box.width, box.height];
    renderer.setViewport(...rectangle);
    renderer.setScissor(...rectangle);
    renderer.render(panel.scene, panel.camera);
  }
}

function resize() {
  if (!renderer) return;
  const grid = find("grid");
  renderer.setPixelRatio(Math.min(window.devicePixelRatio || 1, 2));
  renderer.setSize(grid.clientWidth, grid.clientHeight, false);
  for (const panel of panels) {
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
    panels.forEach((panel) => { panel.scene.getObjectByName("wireframe").visible = event.target.checked; });
    redraw();
  });
  document.addEventListener("keydown", (event) => {
    if (["INPUT", "SELECT"].includes(event.target.tagName) && event.target.type !== "checkbox") return;
    if (event.key === "ArrowLeft") show(current - 1);
    else if (event.key === "ArrowRight") show(current + 1);
  });
  new ResizeObserver(resize).observe(find("grid"));
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
}

function start() {
  fill();
  try {
    renderer = new WebGLRenderer({ antialias: true, alpha: true });
    renderer.autoClear = false;
    renderer.domElement.setAttribute("aria-hidden", "true");
    renderer.domElement.addEventListener("webglcontextrestored", redraw);
    find("grid").append(renderer.domElement);
    panels = [...document.querySelectorAll(".panel")].map(addPanel);
  } catch (reason) { // titles and numbers can still be read
    console.warn(reason);
    document.querySelectorAll(".drawn").forEach((element) => { element.hidden = true; });
    find("message").hidden = false;
  }
  listen();
  show(0);
  resize();
  window.viewer = { panels, show }; // for tests and for the curious
}

start();
