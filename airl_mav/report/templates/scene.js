// Shows one view at a time with plotly, and moves vehicle and obstacles with the time slider.
(() => {
  const views = JSON.parse(document.getElementById("scene-data").textContent);
  const [box, plot, pick, slider, play, clock] = ["scene", "scene-plot", "scene-flight", "scene-time", "scene-play", "scene-clock"]
    .map((id) => document.getElementById(id));
  const canvas = document.createElement("canvas");
  if (!canvas.getContext("webgl2") && !canvas.getContext("webgl")) return;
  box.classList.add("live");
  document.documentElement.classList.add("scene-live");
  const dark = matchMedia("(prefers-color-scheme: dark)");
  let view = null;
  let timer = null;

  // Linear between samples; `pick` returns one number of a sample.
  function at(times, now, pick) {
    let high = times.findIndex((time) => time >= now);
    if (high < 0) high = times.length - 1;
    const low = Math.max(0, high - 1);
    const span = times[high] - times[low];
    const share = span > 0 ? Math.min(1, Math.max(0, (now - times[low]) / span)) : 0;
    return pick(low) + (pick(high) - pick(low)) * share;
  }
  function move() {
    if (!view.path) return null;
    const now = Number(slider.value);
    const { time, place, heading, speed } = view.path;
    const [x, y, z] = [0, 1, 2].map((axis) => at(time, now, (i) => place[i][axis]));
    const turn = at(time, now, (i) => heading[i]);
    const [reach, half] = view.view;
    const ends = half ? [turn - half, turn + half] : [turn, turn];
    const far = half ? reach : 0;
    const [left, right] = ends.map((angle) => [x + far * Math.sin(angle), y + far * Math.cos(angle)]);
    const change = { x: [[left[0], x, right[0]]], y: [[left[1], y, right[1]]], z: [[z, z, z]] };
    const traces = [view.vehicle];
    if (view.moving) {
      const body = view.figure.data[view.moving.trace];
      const shift = view.moving.tours.map((tour) => [0, 1].map((axis) =>
        at(tour.time, now % tour.time[tour.time.length - 1], (i) => tour.place[i][axis])));
      const shifts = view.moving.corners.flatMap((corners, k) => Array(corners).fill(shift[k]));
      change.x.push(body.x.map((value, i) => value + shifts[i][0]));
      change.y.push(body.y.map((value, i) => value + shifts[i][1]));
      change.z.push(body.z);
      traces.push(view.moving.trace);
    }
    clock.textContent = `${(now - view.navigation).toFixed(1)} s · ${at(time, now, (i) => speed[i]).toFixed(1)} m/s`;
    return Plotly.restyle(plot, change, traces);
  }
  async function show() {
    stop();
    view = views[Number(pick.value)];
    const ink = getComputedStyle(document.body).color;
    const layout = { ...structuredClone(view.figure.layout), font: { color: ink } };
    for (const axis of ["xaxis", "yaxis", "zaxis"]) {
      Object.assign(layout.scene[axis], { gridcolor: "#8d969f55", zerolinecolor: "#8d969f88", backgroundcolor: "rgba(0,0,0,0)" });
    }
    await Plotly.newPlot(plot, structuredClone(view.figure.data), layout, {
      responsive: true, displaylogo: false, scrollZoom: false, modeBarButtonsToRemove: ["sendChartToCloud"],
    });
    slider.disabled = play.disabled = !view.path;
    clock.textContent = "";
    if (view.path) {
      [slider.min, slider.max] = [view.path.time[0], view.path.time[view.path.time.length - 1]];
      slider.value = slider.max;
      await move();
    }
    box.dataset.shown = pick.value;
  }
  function stop() {
    clearInterval(timer);
    timer = null;
    play.textContent = "Play";
  }
  play.addEventListener("click", () => {
    if (timer) return stop();
    if (Number(slider.value) >= Number(slider.max)) slider.value = slider.min;
    play.textContent = "Stop";
    // A flight is over in ten seconds at the most.
    const step = Math.max(1, (slider.max - slider.min) / 10) * 0.1;
    timer = setInterval(() => {
      slider.value = Number(slider.value) + step;
      move();
      if (Number(slider.value) >= Number(slider.max)) stop();
    }, 100);
  });
  slider.addEventListener("input", () => { stop(); move(); });
  pick.addEventListener("change", show);
  dark.addEventListener("change", show);
  for (const link of document.querySelectorAll("[data-scene]")) {
    link.addEventListener("click", () => { pick.value = link.dataset.scene; show(); });
  }
  show();
})();
