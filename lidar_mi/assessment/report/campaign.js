// What a dot or a cell is: its settings and its value, at the foot of the page.
(() => {
  "use strict";
  const points = JSON.parse(document.getElementById("points").textContent);
  const where = document.getElementById("where");

  function show(event) {
    const mark = event.target.closest && event.target.closest("a[data-point]");
    if (!mark) return;
    const title = mark.querySelector("title").textContent, place = points[mark.dataset.point];
    where.textContent = place ? place + ": " + title : title;
  }

  document.addEventListener("pointerover", show);
  document.addEventListener("focusin", show);
})();
