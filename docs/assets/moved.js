// A link to a heading that moved to another page leads there. tools/site_hooks.py marks such headings.
function follow() {
  const moved = document.getElementById(decodeURIComponent(location.hash.slice(1)))?.dataset.moved;
  if (moved) location.replace(moved);
}
addEventListener("hashchange", follow);
follow();
