// The flights of a report in three dimensions. Plain WebGL: nothing is loaded, nothing leaves the page.
// Frame: x east, y north, z up [m], from the start.
(function () {
  "use strict";

  const box = document.getElementById("scene");
  const canvas = box.querySelector("canvas");
  const gl = canvas.getContext("webgl", { antialias: true, alpha: true });
  const say = box.querySelector(".scene-note");
  if (!gl) {
    say.textContent = "This browser offers no WebGL: the still picture stays.";
    box.classList.add("still");
    return;
  }
  const data = JSON.parse(document.getElementById("scene-data").textContent);
  const pick = document.getElementById("scene-flight");
  const slider = document.getElementById("scene-time");
  const play = document.getElementById("scene-play");
  const clock = document.getElementById("scene-clock");
  const scale = box.querySelector(".scene-scale");
  const dark = window.matchMedia("(prefers-color-scheme: dark)");

  // --- Vectors and matrices (column-major) ---

  const sub = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
  const cross = (a, b) => [
    a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
  const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  function unit(a) {
    const n = Math.hypot(a[0], a[1], a[2]) || 1;
    return [a[0] / n, a[1] / n, a[2] / n];
  }
  function multiply(a, b) {
    const c = new Float32Array(16);
    for (let i = 0; i < 4; i++) {
      for (let j = 0; j < 4; j++) {
        for (let k = 0; k < 4; k++) c[4 * i + j] += a[4 * k + j] * b[4 * i + k];
      }
    }
    return c;
  }
  function perspective(angle, aspect, near, far) {
    const f = 1 / Math.tan(angle / 2);
    const d = 1 / (near - far);
    return [f / aspect, 0, 0, 0, 0, f, 0, 0, 0, 0, (near + far) * d, -1, 0, 0, 2 * near * far * d, 0];
  }
  function lookAt(eye, target) {
    const z = unit(sub(eye, target));
    const x = unit(cross([0, 0, 1], z));
    const y = cross(z, x);
    return [x[0], y[0], z[0], 0, x[1], y[1], z[1], 0, x[2], y[2], z[2], 0,
      -dot(x, eye), -dot(y, eye), -dot(z, eye), 1];
  }

  // --- The program: one colour a corner, light from above ---

  function compile(kind, source) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
    return shader;
  }
  const program = gl.createProgram();
  gl.attachShader(program, compile(gl.VERTEX_SHADER, `
    attribute vec3 place; attribute vec3 normal; attribute vec4 colour;
    uniform mat4 view; varying vec4 shade;
    void main() {
      float lit = length(normal) > 0.5 ? 0.62 + 0.38 * max(0.0, dot(normal, vec3(-0.38, -0.48, 0.79))) : 1.0;
      shade = vec4(colour.rgb * lit * colour.a, colour.a);
      gl_Position = view * vec4(place, 1.0);
    }`));
  gl.attachShader(program, compile(gl.FRAGMENT_SHADER, `
    precision mediump float; varying vec4 shade;
    void main() { gl_FragColor = shade; }`));
  gl.linkProgram(program);
  gl.useProgram(program);
  const viewAt = gl.getUniformLocation(program, "view");
  const STRIDE = 10;
  const layout = [["place", 3, 0], ["normal", 3, 3], ["colour", 4, 6]].map(
    ([name, size, at]) => [gl.getAttribLocation(program, name), size, at]);

  class Mesh {
    constructor(mode) {
      this.mode = mode;
      this.numbers = [];
      this.count = 0;
      this.buffer = gl.createBuffer();
    }
    clear() { this.numbers = []; }
    corner(place, normal, colour) {
      this.numbers.push(place[0], place[1], place[2], normal[0], normal[1], normal[2], ...colour);
    }
    triangle(a, b, c, colour, normal) {
      const n = normal || unit(cross(sub(b, a), sub(c, a)));
      for (const corner of [a, b, c]) this.corner(corner, n, colour);
    }
    quad(a, b, c, d, colour, normal) {
      this.triangle(a, b, c, colour, normal);
      this.triangle(a, c, d, colour, normal);
    }
    line(a, b, colour) {
      this.corner(a, [0, 0, 0], colour);
      this.corner(b, [0, 0, 0], colour);
    }
    upload() {
      this.count = this.numbers.length / STRIDE;
      gl.bindBuffer(gl.ARRAY_BUFFER, this.buffer);
      gl.bufferData(gl.ARRAY_BUFFER, new Float32Array(this.numbers), gl.STATIC_DRAW);
      this.numbers = [];
    }
    draw() {
      if (!this.count) return;
      gl.bindBuffer(gl.ARRAY_BUFFER, this.buffer);
      for (const [at, size, offset] of layout) {
        gl.enableVertexAttribArray(at);
        gl.vertexAttribPointer(at, size, gl.FLOAT, false, 4 * STRIDE, 4 * offset);
      }
      gl.drawArrays(this.mode, 0, this.count);
    }
  }
  const solid = new Mesh(gl.TRIANGLES);   // floor, obstacles that stand, paths
  const lines = new Mesh(gl.LINES);       // grid, tours, shadows
  const walls = new Mesh(gl.TRIANGLES);   // seen from inside only
  const moving = new Mesh(gl.TRIANGLES);  // what the time slider moves
  const glass = new Mesh(gl.TRIANGLES);   // goal, field of view

  // --- Colours ---

  function rgb(hex, alpha = 1) {
    const n = parseInt(hex.slice(1), 16);
    return [(n >> 16) / 255, ((n >> 8) & 255) / 255, (n & 255) / 255, alpha];
  }
  const themed = (pair, alpha) => rgb(pair[dark.matches ? 1 : 0], alpha);
  function css(name, alpha) {
    return rgb(getComputedStyle(document.documentElement).getPropertyValue(name).trim(), alpha);
  }
  function speedColour(speed) {
    const colours = data.speedColours;
    const at = Math.min(1, Math.max(0, speed / (data.topSpeed || 1))) * (colours.length - 1);
    const low = Math.floor(at);
    const a = rgb(colours[low]);
    const b = rgb(colours[Math.min(low + 1, colours.length - 1)]);
    return a.map((value, i) => value + (b[i] - value) * (at - low));
  }

  // --- Shapes ---

  function prism(mesh, outline, low, high, colour) {
    const n = outline.length;
    const top = outline.map((p) => [p[0], p[1], high]);
    for (let i = 0; i < n; i++) {
      const a = outline[i];
      const b = outline[(i + 1) % n];
      const normal = unit([b[1] - a[1], a[0] - b[0], 0]);
      mesh.quad([a[0], a[1], low], [b[0], b[1], low], [b[0], b[1], high], [a[0], a[1], high], colour, normal);
      if (i > 0 && i < n - 1) mesh.triangle(top[0], top[i], top[i + 1], colour, [0, 0, 1]);
    }
  }
  function circle(x, y, radius, corners) {
    return Array.from({ length: corners }, (_, i) => {
      const turn = (2 * Math.PI * i) / corners;
      return [x + radius * Math.cos(turn), y + radius * Math.sin(turn)];
    });
  }
  function sphere(mesh, center, radius, colour, around = 24) {
    const rings = around / 2;
    const at = (i, j) => {
      const up = Math.PI * (i / rings - 0.5);
      const turn = (2 * Math.PI * j) / around;
      return [Math.cos(up) * Math.cos(turn), Math.cos(up) * Math.sin(turn), Math.sin(up)];
    };
    const place = (n) => n.map((value, axis) => center[axis] + radius * value);
    for (let i = 0; i < rings; i++) {
      for (let j = 0; j < around; j++) {
        const ring = [at(i, j), at(i, j + 1), at(i + 1, j + 1), at(i + 1, j)];
        for (const k of [0, 1, 2, 0, 2, 3]) mesh.corner(place(ring[k]), ring[k], colour);
      }
    }
  }
  function obstacle(mesh, thing, center, colour) {
    const [x, y, z] = center;
    const [first, second, up] = thing.half;
    if (thing.shape === "sphere") {
      sphere(mesh, center, first, colour);
    } else if (thing.shape === "cylinder") {
      prism(mesh, circle(x, y, first, 32), z - up, z + up, colour);
    } else {
      // Yaw turns the first axis from north to the east.
      const yaw = (thing.yaw * Math.PI) / 180;
      const a = [Math.sin(yaw) * first, Math.cos(yaw) * first];
      const b = [-Math.cos(yaw) * second, Math.sin(yaw) * second];
      const outline = [[-1, 1], [-1, -1], [1, -1], [1, 1]].map(
        ([s, t]) => [x + s * a[0] + t * b[0], y + s * a[1] + t * b[1]]);
      prism(mesh, outline, z - up, z + up, colour);
    }
  }
  function tube(mesh, points, colours, radius, sides) {
    const rings = points.map((p, i) => {
      const along = unit(sub(points[Math.min(i + 1, points.length - 1)], points[Math.max(i - 1, 0)]));
      const side = unit(cross(along, Math.abs(along[2]) > 0.9 ? [1, 0, 0] : [0, 0, 1]));
      const up = cross(side, along);
      return Array.from({ length: sides }, (_, k) => {
        const turn = (2 * Math.PI * k) / sides;
        return side.map((value, axis) => value * Math.cos(turn) + up[axis] * Math.sin(turn));
      });
    });
    for (let i = 0; i + 1 < points.length; i++) {
      for (let k = 0; k < sides; k++) {
        const next = (k + 1) % sides;
        for (const [at, side] of [[i, k], [i, next], [i + 1, next], [i, k], [i + 1, next], [i + 1, k]]) {
          const n = rings[at][side];
          mesh.corner(points[at].map((value, axis) => value + radius * n[axis]), n, colours[at]);
        }
      }
    }
  }

  // --- What is shown ---

  function placesOf(flight) {
    return flight.time.map((_, i) => flight.place.slice(3 * i, 3 * i + 3));
  }
  function arenaOf(flight) {
    if (flight) return flight.arena === null ? null : data.arenas[flight.arena];
    return data.arenas.length ? data.arenas[0] : null;
  }
  function boundsOf(arena, flights) {
    if (arena) return arena.bounds;
    const low = [-2, -2];
    const high = [2, 2];
    for (const flight of flights) {
      for (const p of [...placesOf(flight), flight.goal]) {
        for (const axis of [0, 1]) {
          low[axis] = Math.min(low[axis], p[axis] - 2);
          high[axis] = Math.max(high[axis], p[axis] + 2);
        }
      }
    }
    return [low[0], high[0], low[1], high[1], 0];
  }
  function ground(arena, bounds) {
    const [west, east, south, north, height] = bounds;
    solid.quad([west, south, 0], [east, south, 0], [east, north, 0], [west, north, 0],
      css("--floor"), [0, 0, 0]);
    const grid = css("--rule");
    for (let x = Math.ceil(west / 10) * 10; x <= east; x += 10) lines.line([x, south, 0.02], [x, north, 0.02], grid);
    for (let y = Math.ceil(south / 10) * 10; y <= north; y += 10) lines.line([west, y, 0.02], [east, y, 0.02], grid);
    if (!arena) return;
    const corners = [[west, south], [east, south], [east, north], [west, north]];
    const paint = [...arena.wall, 0.22];
    corners.forEach((a, i) => {
      const b = corners[(i + 1) % 4];
      // Faces look inward, and what looks away is not drawn: near walls do not hide the flight.
      walls.quad([b[0], b[1], 0], [a[0], a[1], 0], [a[0], a[1], height], [b[0], b[1], height], paint, [0, 0, 0]);
      lines.line([a[0], a[1], height], [b[0], b[1], height], grid);
    });
  }
  function still(arena) {
    if (!arena) return;
    const count = arena.obstacles.length - arena.tours.length;
    const colour = themed(data.colours.still);
    for (const thing of arena.obstacles.slice(0, count)) obstacle(solid, thing, thing.center, colour);
    const way = themed(data.colours.moving);
    for (const tour of arena.tours) {
      for (let i = 0; i + 3 < tour.place.length; i += 2) {
        lines.line([tour.place[i], tour.place[i + 1], 0.05], [tour.place[i + 2], tour.place[i + 3], 0.05], way);
      }
    }
  }
  function goalOf(flight, opacity) {
    const [x, y] = flight.goal;
    const rim = circle(x, y, flight.radius, 40);
    const colour = themed(data.colours.goal, opacity);
    rim.forEach((a, i) => {
      const b = rim[(i + 1) % rim.length];
      glass.triangle([x, y, 0.06], [a[0], a[1], 0.06], [b[0], b[1], 0.06], colour, [0, 0, 0]);
    });
    lines.line([x, y, 0], [x, y, 4], themed(data.colours.goal));
    sphere(solid, [x, y, 4], 0.35, themed(data.colours.goal), 12);
  }
  function start() {
    const colour = themed(data.colours.start);
    prism(solid, [[-0.7, -0.6], [0.7, -0.6], [0, 1]], 0, 0.12, colour);
  }
  function pathOf(flight, colourAt, radius, sides, end) {
    const points = placesOf(flight);
    tube(solid, points, points.map((_, i) => colourAt(i)), radius, sides);
    sphere(solid, points[points.length - 1], end, themed(data.outcomes[flight.outcome].colour), 12);
    return points;
  }

  let flight = null;
  let arena = null;

  function build() {
    flight = pick.value === "all" ? null : data.flights[Number(pick.value)];
    arena = arenaOf(flight);
    for (const mesh of [solid, lines, walls, glass]) mesh.clear();
    const shown = flight ? [flight] : data.all;
    const bounds = boundsOf(arena, shown);
    ground(arena, bounds);
    start();
    if (flight) {
      still(arena);
      goalOf(flight, 0.3);
      const points = pathOf(flight, (i) => speedColour(flight.speed[i]), 0.13, 6, 0.38);
      const shadow = css("--muted", 0.8);
      for (let i = 0; i + 1 < points.length; i++) {
        lines.line([points[i][0], points[i][1], 0.04], [points[i + 1][0], points[i + 1][1], 0.04], shadow);
      }
    } else {
      if (data.shared) still(arena);
      for (const other of data.all) {
        const colour = themed(data.outcomes[other.outcome].colour);
        pathOf(other, () => colour, 0.07, 3, other.outcome === "success" ? 0.12 : 0.38);
      }
    }
    for (const mesh of [solid, lines, walls]) mesh.upload();
    glass.still = glass.numbers;
    slider.disabled = play.disabled = !flight;
    if (flight) {
      const end = flight.time[flight.time.length - 1];
      slider.min = flight.time[0];
      slider.max = end;
      slider.step = 0.02;
      if (slider.dataset.flight !== pick.value) slider.value = end;
      slider.dataset.flight = pick.value;
    }
    showScale();
    move();
    return bounds;
  }
  function showScale() {
    scale.replaceChildren();
    const add = (tag, text, style) => {
      const part = document.createElement(tag);
      part.textContent = text;
      if (style) part.style.background = style;
      scale.append(part);
    };
    if (flight) {
      add("span", "0");
      add("i", "", `linear-gradient(90deg, ${data.speedColours.join(",")})`);
      add("span", `${data.topSpeed.toFixed(1)} m/s`);
    } else {
      for (const [key, outcome] of Object.entries(data.outcomes)) {
        const count = data.all.filter((other) => other.outcome === key).length;
        if (!count) continue;
        add("b", "", outcome.colour[dark.matches ? 1 : 0]);
        add("span", `${outcome.words} (${count})`);
      }
    }
  }
  function between(times, at) {
    let high = times.findIndex((time) => time >= at);
    if (high < 0) high = times.length - 1;
    const low = Math.max(0, high - 1);
    const span = times[high] - times[low];
    return [low, high, span > 0 ? Math.min(1, Math.max(0, (at - times[low]) / span)) : 0];
  }
  // Puts the vehicle, its camera's field of view and the moving obstacles where they were.
  function move() {
    moving.clear();
    glass.numbers = glass.still.slice();
    if (flight) {
      const now = Number(slider.value);
      const [low, high, share] = between(flight.time, now);
      const mix = (a, b) => a + (b - a) * share;
      const place = [0, 1, 2].map((axis) => mix(flight.place[3 * low + axis], flight.place[3 * high + axis]));
      let turn = flight.heading[high] - flight.heading[low];
      turn -= 360 * Math.round(turn / 360);
      const heading = ((flight.heading[low] + turn * share) * Math.PI) / 180;
      const ahead = (angle, reach) => [
        place[0] + reach * Math.sin(heading + angle), place[1] + reach * Math.cos(heading + angle), place[2]];
      const ink = css("--ink");
      const hull = [[0, 0.6], [2.5, 0.45], [-2.5, 0.45]].map(([angle, reach]) => ahead(angle, reach));
      prism(moving, [hull[0], hull[2], hull[1]], place[2] - 0.08, place[2] + 0.12, ink);
      const half = (data.fov * Math.PI) / 360;
      for (let i = 0; data.fov && i < 8; i++) {
        const a = half * (i / 4 - 1);
        glass.triangle(place, ahead(a, 6), ahead(a + half / 4, 6), css("--ink", 0.16), [0, 0, 0]);
      }
      if (arena) {
        const count = arena.obstacles.length - arena.tours.length;
        arena.tours.forEach((tour, k) => {
          const thing = arena.obstacles[count + k];
          const period = tour.time[tour.time.length - 1];
          const [i, j, part] = between(tour.time, now % period);
          const at = (axis) => tour.place[2 * i + axis] + (tour.place[2 * j + axis] - tour.place[2 * i + axis]) * part;
          obstacle(moving, thing, [at(0), at(1), thing.center[2]], themed(data.colours.moving));
        });
      }
      clock.textContent = `${(now - flight.navigation).toFixed(1)} s · ${mix(flight.speed[low], flight.speed[high]).toFixed(1)} m/s`;
    } else {
      clock.textContent = "";
    }
    moving.upload();
    glass.upload();
    ask();
  }

  // --- The camera ---

  const ANGLE = 0.7;
  const eye = { target: [0, 0, 0], turn: 0, above: 0, away: 1 };
  let size = 50;

  function aim(bounds) {
    const [west, east, south, north] = bounds;
    size = Math.max(10, Math.hypot(east - west, north - south));
    eye.target = [(west + east) / 2, (south + north) / 2, 1];
    stand("behind");
  }
  function stand(from) {
    const fit = Math.max(1, 1.5 / Math.max(0.4, canvas.clientWidth / Math.max(1, canvas.clientHeight)));
    eye.away = 0.95 * size * fit;
    eye.turn = from === "side" ? Math.PI / 2 : 0;
    eye.above = { above: 1.5, behind: 0.62, side: 0.42 }[from];
    ask();
  }
  function clamp() {
    eye.above = Math.min(1.55, Math.max(0.03, eye.above));
    eye.away = Math.min(4 * size, Math.max(2, eye.away));
    ask();
  }
  let asked = false;
  function ask() {
    if (asked) return;
    asked = true;
    requestAnimationFrame(draw);
  }
  function draw() {
    asked = false;
    const ratio = Math.min(2, window.devicePixelRatio || 1);
    const width = Math.round(canvas.clientWidth * ratio);
    const height = Math.round(canvas.clientHeight * ratio);
    if (!width || !height) return;
    if (canvas.width !== width || canvas.height !== height) {
      canvas.width = width;
      canvas.height = height;
    }
    const flat = Math.cos(eye.above) * eye.away;
    // Turn 0 looks north.
    const from = [
      eye.target[0] - flat * Math.sin(eye.turn), eye.target[1] - flat * Math.cos(eye.turn),
      eye.target[2] + Math.sin(eye.above) * eye.away];
    const view = multiply(perspective(ANGLE, width / height, 0.02 * eye.away, eye.away + 2 * size), lookAt(from, eye.target));
    gl.viewport(0, 0, width, height);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.uniformMatrix4fv(viewAt, false, view);
    gl.enable(gl.DEPTH_TEST);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.disable(gl.CULL_FACE);
    for (const mesh of [solid, moving, lines]) mesh.draw();
    gl.depthMask(false);
    gl.enable(gl.CULL_FACE);
    walls.draw();
    gl.disable(gl.CULL_FACE);
    glass.draw();
    gl.depthMask(true);
    box.dataset.corners = solid.count + moving.count;
  }

  // --- Hands ---

  const fingers = new Map();
  function pan(dx, dy) {
    const step = (2 * eye.away * Math.tan(ANGLE / 2)) / Math.max(1, canvas.clientHeight);
    const [sin, cos] = [Math.sin(eye.turn), Math.cos(eye.turn)];
    eye.target[0] += step * (-dx * cos + dy * sin);
    eye.target[1] += step * (dx * sin + dy * cos);
  }
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    fingers.set(event.pointerId, [event.clientX, event.clientY]);
  });
  for (const name of ["pointerup", "pointercancel"]) {
    canvas.addEventListener(name, (event) => fingers.delete(event.pointerId));
  }
  canvas.addEventListener("pointermove", (event) => {
    const last = fingers.get(event.pointerId);
    if (!last) return;
    const here = [event.clientX, event.clientY];
    const [dx, dy] = [here[0] - last[0], here[1] - last[1]];
    if (fingers.size > 1) {
      const other = [...fingers].find(([id]) => id !== event.pointerId)[1];
      const before = Math.hypot(last[0] - other[0], last[1] - other[1]);
      const after = Math.hypot(here[0] - other[0], here[1] - other[1]);
      if (after > 0) eye.away *= before / after;
      pan(dx / 2, dy / 2);
    } else if (event.shiftKey || event.buttons === 2) {
      pan(dx, dy);
    } else {
      eye.turn += 0.008 * dx;
      if (event.pointerType !== "touch") eye.above += 0.008 * dy;
    }
    fingers.set(event.pointerId, here);
    clamp();
  });
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener("wheel", (event) => {
    // The page scrolls on, until the picture has been clicked.
    if (document.activeElement !== canvas) return;
    event.preventDefault();
    eye.away *= Math.exp(0.001 * event.deltaY);
    clamp();
  }, { passive: false });
  const KEYS = {
    ArrowLeft: () => { eye.turn -= 0.12; },
    ArrowRight: () => { eye.turn += 0.12; },
    ArrowUp: () => { eye.above += 0.08; },
    ArrowDown: () => { eye.above -= 0.08; },
    "+": () => { eye.away /= 1.15; },
    "=": () => { eye.away /= 1.15; },
    "-": () => { eye.away *= 1.15; },
    0: () => stand("behind"),
  };
  canvas.addEventListener("keydown", (event) => {
    const act = KEYS[event.key];
    if (!act || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    act();
    clamp();
  });
  for (const button of box.querySelectorAll("[data-stand]")) {
    button.addEventListener("click", () => stand(button.dataset.stand));
  }
  for (const button of box.querySelectorAll("[data-zoom]")) {
    button.addEventListener("click", () => {
      eye.away *= Number(button.dataset.zoom);
      clamp();
    });
  }

  // --- Time ---

  let playing = false;
  let before = 0;
  function stop() {
    playing = false;
    play.textContent = "Play";
  }
  function tick(now) {
    if (!playing) return;
    // A flight is over in ten seconds at the most.
    const pace = Math.max(1, (slider.max - slider.min) / 10);
    slider.value = Number(slider.value) + (pace * Math.min(100, now - before)) / 1000;
    before = now;
    move();
    if (Number(slider.value) >= Number(slider.max)) stop();
    else requestAnimationFrame(tick);
  }
  play.addEventListener("click", () => {
    if (playing) {
      stop();
      return;
    }
    if (Number(slider.value) >= Number(slider.max)) slider.value = slider.min;
    playing = true;
    play.textContent = "Stop";
    before = performance.now();
    requestAnimationFrame(tick);
  });
  slider.addEventListener("input", () => { stop(); move(); });
  pick.addEventListener("change", () => { stop(); aim(build()); });
  dark.addEventListener("change", () => build());
  window.addEventListener("resize", ask);
  for (const link of document.querySelectorAll("[data-scene]")) {
    link.addEventListener("click", () => {
      pick.value = link.dataset.scene;
      stop();
      aim(build());
    });
  }
  canvas.addEventListener("webglcontextlost", (event) => {
    event.preventDefault();
    box.classList.replace("live", "still");
    document.documentElement.classList.remove("scene-live");
    say.textContent = "The browser took its 3-D drawing away: the still picture stays. Reload to try again.";
  });

  box.classList.add("live");
  document.documentElement.classList.add("scene-live");
  aim(build());
})();
