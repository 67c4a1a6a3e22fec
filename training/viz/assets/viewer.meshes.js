// From what the page embeds to what three.js draws: positions, colours, shadows.
import {
  BufferAttribute, BufferGeometry, Color, DataTexture, DoubleSide, LinearFilter, Mesh, MeshBasicMaterial, MeshStandardMaterial,
  PlaneGeometry, RGBAFormat, SRGBColorSpace,
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

export function surface(mesh, colors) {
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
  shadow.renderOrder = -1;
  return shadow;
}

export function clear(scene) {
  for (const child of [...scene.children].filter((one) => one.isMesh)) {
    scene.remove(child);
    child.traverse((one) => { one.geometry.dispose(); one.material.map?.dispose(); one.material.dispose(); });
  }
}
