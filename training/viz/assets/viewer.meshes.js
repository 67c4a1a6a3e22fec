// From what the page embeds to what three.js draws: positions, colours, shadows.
import {
  BufferAttribute, BufferGeometry, Color, DataTexture, DoubleSide, LinearFilter, Mesh, MeshBasicMaterial, MeshStandardMaterial,
  PlaneGeometry, RepeatWrapping, RGBAFormat, SRGBColorSpace, Texture,
} from "three";
import { data, find } from "./viewer.data.js";

const faceCache = new Map();

export function bytes(base64) {
  return Uint8Array.from(atob(base64), (letter) => letter.charCodeAt(0));
}

// Little-endian whatever the machine, as written.
export function decode(base64, kind) {
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

export function roleColors(color, count) {
  const linear = new Color().setRGB(...color, SRGBColorSpace);
  return Float32Array.from({ length: 3 * count }, (_, index) => [linear.r, linear.g, linear.b][index % 3]);
}

export function errorColors(errors) {
  const map = data.error.colors.map((color) => new Color().setRGB(...color.map((level) => level / 255), SRGBColorSpace));
  const result = new Float32Array(3 * errors.length);
  errors.forEach((error, index) => {
    const level = Math.min(Math.round((255 * error) / data.error.limit), 255);
    map[level].toArray(result, 3 * index);
  });
  return result;
}

export function shaded(colors, openness, strength) {
  return colors.map((value, index) => value * (1 - strength * (1 - openness[Math.floor(index / 3)] / 255)));
}

const lookCache = new Map();
const matt = { vertexColors: true, side: DoubleSide, roughness: 0.62, metalness: 0, polygonOffset: true, polygonOffsetFactor: 1, polygonOffsetUnits: 1 };

// What the faces of a file look like: vertices split where texture coordinates part, and a paint for each group of faces.
function lookOf(key) {
  if (key && !lookCache.has(key)) {
    const { of, faces: indices, uvs, colors, paints } = data.looks[key];
    const whole = { of: decode(of, "uint32"), faces: decode(indices, "uint32"), uvs: decode(uvs, "float32"), colors: null };
    if (colors) {
      const one = new Color();
      const levels = bytes(colors);
      whole.colors = new Float32Array(levels.length);
      for (let at = 0; at < levels.length; at += 3) {
        one.setRGB(levels[at] / 255, levels[at + 1] / 255, levels[at + 2] / 255, SRGBColorSpace).toArray(whole.colors, at);
      }
    }
    whole.paints = paints.map(({ color, faces: count, texture }) => ({ color, count, map: texture && textureOf(texture) }));
    lookCache.set(key, whole);
  }
  return lookCache.get(key);
}

function textureOf(address) {
  const image = new Image();
  const texture = new Texture(image);
  Object.assign(texture, { colorSpace: SRGBColorSpace, wrapS: RepeatWrapping, wrapT: RepeatWrapping, anisotropy: 4 });
  image.addEventListener("load", () => {
    texture.needsUpdate = true;
    window.dispatchEvent(new Event("painted"));
  });
  image.src = address;
  return texture;
}

function gathered(values, of, width = 3) {
  const result = new Float32Array(width * of.length);
  for (let row = 0; row < of.length; row += 1) for (let axis = 0; axis < width; axis += 1) result[width * row + axis] = values[width * of[row] + axis];
  return result;
}

function painted(plain, look) {
  const geometry = new BufferGeometry();
  for (const name of ["position", "normal", "color"]) geometry.setAttribute(name, new BufferAttribute(gathered(plain.getAttribute(name).array, look.of), 3));
  if (look.colors) geometry.getAttribute("color").array.forEach((light, index, all) => { all[index] = light * look.colors[index]; });
  geometry.setAttribute("uv", new BufferAttribute(look.uvs, 2));
  geometry.setIndex(new BufferAttribute(look.faces, 1));
  let start = 0;
  look.paints.forEach(({ count }, number) => {
    if (count) geometry.addGroup(start, 3 * count, number);
    start += 3 * count;
  });
  return geometry;
}

// A mesh in colours of its vertices or, with a look, in its own; `colors` are then how light its vertices are.
export function surface(mesh, colors, lookKey) {
  const plain = new BufferGeometry();
  plain.setAttribute("position", new BufferAttribute(positions(mesh), 3));
  plain.setAttribute("color", new BufferAttribute(colors, 3));
  plain.setIndex(faces(mesh.faces).clone());
  plain.computeVertexNormals();
  const look = lookOf(lookKey);
  const geometry = look ? painted(plain, look) : plain;
  const material = look
    ? look.paints.map(({ color, map }) => new MeshStandardMaterial({ ...matt, roughness: 0.8, color: new Color(...color), map }))
    : new MeshStandardMaterial(matt);
  const body = new Mesh(geometry, material);
  Object.assign(body, { name: "body", userData: { plain, look, faces: mesh.faces } });
  const wires = new MeshBasicMaterial({ color: 0x10151d, wireframe: true, transparent: true, opacity: 0.38 });
  const wire = new Mesh(geometry, wires);
  wire.name = "wireframe";
  wire.visible = find("wireframe").checked;
  body.add(wire);
  return body;
}

// Another frame of the same mesh; false where its triangles are others.
export function move(body, mesh) {
  const { plain, look, faces: key } = body.userData;
  if (key !== mesh.faces) return false;
  plain.getAttribute("position").copyArray(positions(mesh));
  plain.computeVertexNormals();
  for (const name of ["position", "normal"]) {
    const attribute = body.geometry.getAttribute(name);
    if (look) attribute.copyArray(gathered(plain.getAttribute(name).array, look.of));
    attribute.needsUpdate = true;
  }
  body.geometry.boundingSphere = null;
  return true;
}

export function ground(mesh) {
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
  Object.assign(shadow, { renderOrder: -1, name: "ground" });
  return shadow;
}

export function discard(scene, child) {
  scene.remove(child);
  child.traverse((one) => {
    one.geometry.dispose();
    for (const material of [one.material].flat()) {
      if (material.map?.isDataTexture) material.map.dispose(); // textures of looks are kept for other examples
      material.dispose();
    }
  });
}

export function clear(scene) {
  for (const child of [...scene.children].filter((one) => one.isMesh)) discard(scene, child);
}
