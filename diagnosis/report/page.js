// Plays the animations: each figure holds its frames as JSON, one list of SVG paths for each look.
for (const figure of document.querySelectorAll("figure.animation")) {
  const paths = JSON.parse(figure.querySelector("script").textContent);
  const button = figure.querySelector("button");
  const slider = figure.querySelector("input");
  const frames = Number(slider.max) + 1;
  const pause = 0.8; // s, before it begins again
  const seconds = Number(figure.dataset.seconds);
  let playing = !matchMedia("(prefers-reduced-motion: reduce)").matches;
  let from = performance.now();

  const show = (k) => {
    for (const look in paths) {
      figure.querySelector(".layer." + look).setAttribute("d", paths[look][k]);
    }
    slider.value = k;
  };
  const name = () => {
    button.textContent = playing ? "pause" : "play";
  };
  const step = (now) => {
    if (!playing) return;
    const t = (Math.max(0, now - from) / 1000) % (seconds + pause);
    show(Math.min(frames - 1, Math.floor((t / seconds) * frames)));
    requestAnimationFrame(step);
  };
  const play = () => {
    from = performance.now() - (slider.value / frames) * seconds * 1000;
    requestAnimationFrame(step);
  };
  button.onclick = () => {
    playing = !playing;
    name();
    if (playing) play();
  };
  slider.oninput = () => {
    playing = false;
    name();
    show(Number(slider.value));
  };
  name();
  show(0);
  if (playing) play();
}
