// Figures of several panels side by side: on a narrow screen the panels are stacked.
(() => {
  "use strict";
  const narrow = window.matchMedia("(max-width: 40rem)");

  function parts(image) {
    const edges = [0, ...image.dataset.cuts.split(" ").map(Number), 1];
    const stack = document.createElement("div");
    stack.className = "stack";
    for (let k = 1; k < edges.length; k++) {
      const width = edges[k] - edges[k - 1], box = document.createElement("div"), part = image.cloneNode();
      delete part.dataset.cuts;
      part.hidden = false;
      if (k > 1) part.alt = "";
      part.style.width = 100 / width + "%";
      part.style.marginLeft = -100 * edges[k - 1] / width + "%";
      box.append(part);
      stack.append(box);
    }
    return stack;
  }

  function arrange() {
    document.querySelectorAll(".stack").forEach(stack => stack.remove());
    document.querySelectorAll("img[data-cuts]").forEach(image => {
      image.hidden = narrow.matches;
      if (narrow.matches) image.after(parts(image));
    });
  }

  narrow.addEventListener("change", arrange);
  arrange();
})();
