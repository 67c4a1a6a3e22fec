// MLflow shows a page from memory in a locked frame: there no link leads anywhere, not even to a heading of the page
// itself. So frames give way to words, and the contents list scrolls.
const alone = !/^(file|https?):$/.test(location.protocol);
for (const frame of document.querySelectorAll("iframe[data-src]")) {
  if (alone) frame.closest("figure").classList.add("alone");
  else frame.src = frame.dataset.src;
}
document.addEventListener("click", (event) => {
  const link = alone && event.target.closest('a[href^="#"]');
  if (!link) return;
  event.preventDefault();
  document.getElementById(link.getAttribute("href").slice(1)).scrollIntoView();
});
