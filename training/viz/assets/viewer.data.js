// What training/viz/viewer.py wrote into the page.
export const data = JSON.parse(document.getElementById("data").textContent);
export const errors = data.examples.some((example) => Object.keys(example.errors).length);
export const stacked = errors && data.methods.length > 1; // an error below each output

export function find(id) {
  return document.getElementById(id);
}
