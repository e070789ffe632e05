// Frames of a flight with a slider: without this script, the frame shown is the one in the page.
for (const film of document.querySelectorAll(".film")) {
  const frames = JSON.parse(film.querySelector("script").textContent);
  const [image, slider, button, words] = ["img", "input", "button", ".now"].map(s => film.querySelector(s));
  let playing = null;
  const show = k => {
    slider.value = k;
    image.src = "data:image/webp;base64," + frames[k].data;
    words.textContent = image.alt = frames[k].caption;
    slider.setAttribute("aria-valuetext", frames[k].caption);
  };
  const stop = () => { clearInterval(playing); playing = null; button.textContent = "Play"; };
  slider.max = frames.length - 1;
  slider.addEventListener("input", () => { stop(); show(+slider.value); });
  button.addEventListener("click", () => {
    if (playing) return stop();
    button.textContent = "Stop";
    if (+slider.value === frames.length - 1) show(0);
    playing = setInterval(() => {
      const next = +slider.value + 1;
      if (next === frames.length) return stop();
      show(next);
    }, +film.dataset.milliseconds);
  });
  film.querySelector(".controls").hidden = false;
  show(+slider.value);
}
