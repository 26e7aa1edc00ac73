// Unpacks what travels compressed in the page, and shows the flight and the moment that are chosen.
(async () => {
  async function unpack(id) {
    const bytes = Uint8Array.from(atob(document.getElementById(id).textContent), (letter) => letter.charCodeAt(0));
    return new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"))).text();
  }
  const images = document.querySelectorAll("img[data-picture]");
  if (!window.DecompressionStream) {
    // A browser of before 2023: the same pictures lie beside the page.
    for (const image of images) image.src = `${image.dataset.picture}.png`;
    return;
  }
  const { pictures, views, flights, palette } = JSON.parse(await unpack("page-data"));
  for (const image of images) {
    image.src = URL.createObjectURL(new Blob([pictures[image.dataset.picture]], { type: "image/svg+xml" }));
  }
  performance.mark("pictures");
  const box = document.getElementById("scene");
  if (!box) return;
  // What is there already is painted before the library is read.
  await new Promise((done) => setTimeout(done, 0));
  const library = document.createElement("script");
  library.textContent = await unpack("page-library");
  document.head.append(library);
  performance.mark("library");

  const [pick, slider, play, clock] = ["scene-flight", "scene-time", "scene-play", "scene-clock"]
    .map((id) => document.getElementById(id));
  document.documentElement.classList.add("scripted");
  // The moment shown [s since the reset]: the slider knows it in steps only.
  let view = null, timer = null, now = 0;
  const goTo = (seconds) => { stop(); move(seconds + view.navigation); };
  const scene = makeScene(views);
  const tracks = makeTracks(goTo);
  const seen = makeSeen(palette, goTo);

  function move(moment) {
    now = moment;
    tell();
    return Promise.all([scene?.move(now), tracks.move(now - view.navigation)]);
  }
  function tell() {
    slider.value = now;
    const { time, speed } = view.path;
    const i = Math.max(0, time.findLastIndex((each) => each <= now));
    clock.textContent = `${(now - view.navigation).toFixed(1)} s · ${speed[i].toFixed(1)} m/s`;
    seen.move(now - view.navigation);
  }
  async function show() {
    stop();
    const number = Number(pick.value);
    view = views[number];
    const flight = flights[number];
    seen.show(flight);
    [slider.min, slider.max] = [view.path.time[0], view.path.time[view.path.time.length - 1]];
    now = Number(slider.max);
    tell();
    await tracks.show(flight, now - view.navigation);
    await scene?.show(number, now);
    box.dataset.shown = pick.value;
  }
  function stop() {
    clearInterval(timer);
    timer = null;
    play.textContent = "Play";
  }
  play.addEventListener("click", () => {
    if (timer) return stop();
    const [begin, end] = [Number(slider.min), Number(slider.max)];
    if (now >= end - 0.02) now = begin;
    play.textContent = "Stop";
    // A flight is over in ten seconds at the most.
    const step = Math.max(1, (end - begin) / 10) * 0.1;
    timer = setInterval(() => {
      move(Math.min(end, now + step));
      if (now >= end) stop();
    }, 100);
  });
  slider.addEventListener("input", () => { stop(); move(Number(slider.value)); });
  pick.addEventListener("change", () => show());
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => show());
  for (const link of document.querySelectorAll("[data-scene]")) {
    link.addEventListener("click", () => {
      pick.value = link.dataset.scene;
      show();
    });
  }
  await show();
  performance.mark("drawn");
})();
