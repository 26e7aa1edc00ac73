// The flight in its arena, in three dimensions, by plotly. Needs WebGL.
function makeScene(views) {
  const box = document.getElementById("scene");
  const plot = document.getElementById("scene-plot");
  const canvas = document.createElement("canvas");
  if (!canvas.getContext("webgl2") && !canvas.getContext("webgl")) return null;
  box.classList.add("live");
  let view = null;

  // Linear between samples; `pick` returns one number of a sample.
  function at(times, now, pick) {
    let high = times.findIndex((time) => time >= now);
    if (high < 0) high = times.length - 1;
    const low = Math.max(0, high - 1);
    const span = times[high] - times[low];
    const share = span > 0 ? Math.min(1, Math.max(0, (now - times[low]) / span)) : 0;
    return pick(low) + (pick(high) - pick(low)) * share;
  }
  // What the moment changes: by trace, its new x, y and z.
  function change(now) {
    const { time, place, heading } = view.path;
    const [x, y, z] = [0, 1, 2].map((axis) => at(time, now, (i) => place[i][axis]));
    const turn = at(time, now, (i) => heading[i]);
    const [reach, half] = view.view;
    const ends = [turn - half, turn + half];
    const [left, right] = ends.map((angle) => [x + reach * Math.sin(angle), y + reach * Math.cos(angle)]);
    const places = { x: [[left[0], x, right[0]]], y: [[left[1], y, right[1]]], z: [[z, z, z]] };
    const traces = [view.vehicle];
    if (view.moving) {
      const body = view.figure.data[view.moving.trace];
      const shift = view.moving.tours.map((tour) => [0, 1].map((axis) =>
        at(tour.time, now % tour.time[tour.time.length - 1], (i) => tour.place[i][axis])));
      const shifts = view.moving.corners.flatMap((corners, k) => Array(corners).fill(shift[k]));
      places.x.push(body.x.map((value, i) => value + shifts[i][0]));
      places.y.push(body.y.map((value, i) => value + shifts[i][1]));
      places.z.push(body.z);
      traces.push(view.moving.trace);
    }
    return [places, traces];
  }
  const move = (now) => Plotly.restyle(plot, ...change(now));
  async function show(number, now) {
    view = views[number];
    const data = structuredClone(view.figure.data);
    const [places, traces] = change(now);
    traces.forEach((trace, k) => Object.assign(data[trace], { x: places.x[k], y: places.y[k], z: places.z[k] }));
    const ink = getComputedStyle(document.body).color;
    const layout = { ...structuredClone(view.figure.layout), font: { color: ink } };
    for (const axis of ["xaxis", "yaxis", "zaxis"]) {
      Object.assign(layout.scene[axis], { gridcolor: "#8d969f55", zerolinecolor: "#8d969f88", backgroundcolor: "rgba(0,0,0,0)" });
    }
    await Plotly.newPlot(plot, data, layout, {
      responsive: true, displaylogo: false, displayModeBar: innerWidth > 600, scrollZoom: false, modeBarButtonsToRemove: ["sendChartToCloud"],
    });
  }
  return { show, move };
}
