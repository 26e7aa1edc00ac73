// What the policy saw for a decision, what it chose, and what else it weighed.
function makeSeen(palette, goTo) {
  const box = document.getElementById("seen");
  const [canvas, told, list, back, next] = ["seen-depth", "seen-told", "seen-best", "seen-back", "seen-next"]
    .map((id) => document.getElementById(id));
  const colours = palette.map((hex) => [1, 3, 5].map((k) => parseInt(hex.slice(k, k + 2), 16)));
  let flight = null, decisions = [], shown = -1;

  const signed = (value, digits) => (value < 0 ? "−" : "+") + Math.abs(value).toFixed(digits);
  const action = (forward, right, turn) => {
    const parts = [`${signed(forward, 1)} m/s forward`];
    if (Math.abs(right) > 0.004) parts.push(`${signed(right, 1)} right`);
    return [...parts, `${signed(turn, 0)} °/s`].join(", ");
  };
  function draw(k) {
    shown = k;
    const seen = flight.seen[k];
    const [width, height] = seen.size;
    canvas.width = width;
    canvas.height = height;
    const bytes = Uint8Array.from(atob(seen.image), (letter) => letter.charCodeAt(0));
    const image = new ImageData(width, height);
    const colour = bytes.length > width * height;
    for (let i = 0; i < width * height; i++) {
      image.data.set([...(colour ? bytes.subarray(3 * i, 3 * i + 3) : colours[bytes[i]]), 255], 4 * i);
    }
    canvas.getContext("2d").putImageData(image, 0, 0);
    const { sent, taken } = decisions[seen.number];
    const keys = Object.keys(flight.commands).filter((key) => key !== "sent");
    const chosen = keys.map((key) => numbers(flight.commands[key])[seen.number]);
    const [forward, right, turn] = chosen;
    const words = keys.includes("forward_m_s") ? action(forward, right, turn)
      : keys.map((key, i) => `${TITLES[key].split(/[,[]/)[0].trim()} ${key === "thrust" ? chosen[i].toFixed(2) : signed(chosen[i], 0)}`).join(", ");
    told.textContent = `Decision ${seen.number + 1} of ${decisions.length}: frame of ${taken.toFixed(2)} s, sent at ${sent.toFixed(2)} s: ${words}`;
    list.replaceChildren();
    box.classList.toggle("scored", Boolean(seen.best));
    const asked = (row) => Math.abs(row[1] - forward) + Math.abs(row[2] - right) + Math.abs(row[3] * 180 / Math.PI - turn) < 0.5;
    for (const row of seen.best ?? []) {
      const line = list.insertRow();
      line.insertCell().textContent = action(row[1], row[2], row[3] * 180 / Math.PI);
      line.insertCell().textContent = row[0].toFixed(3);
      line.classList.toggle("flown", asked(row));
    }
    [back.disabled, next.disabled] = [k === 0, k === flight.seen.length - 1];
  }
  function show(chosen) {
    flight = chosen;
    shown = -1;
    box.hidden = !flight.seen.length;
    decisions = spans(flight);
  }
  function move(seconds) {
    if (box.hidden) return;
    let k = flight.seen.findLastIndex(({ number }) => decisions[number].sent <= seconds + 0.001);
    k = Math.max(0, k);
    if (k !== shown) draw(k);
  }
  const step = (by) => goTo(decisions[flight.seen[shown + by].number].sent);
  back.addEventListener("click", () => step(-1));
  next.addEventListener("click", () => step(1));
  return { show, move };
}
