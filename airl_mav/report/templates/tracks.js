// The flight over time: commands, motion, estimator, latency; all rows share one axis of time.
function numbers({ unit, steps }) {
  let sum = 0;
  return steps.map((step) => (sum += step) * unit);
}
const COLOURS = { commanded: "#cf6a12", flown: "#2f7fc4", estimated: "#2c9a5b", other: "#a35bb8" };

const TITLES = {
  forward_m_s: "velocity forward [m/s]", right_m_s: "velocity right [m/s]", yaw_rate_deg_s: "yaw rate, clockwise [°/s]",
  roll_deg: "roll [°]", pitch_deg: "pitch [°]", heading_deg: "heading [°]", thrust: "thrust, 0 to 1",
  body_roll_rate_deg_s: "roll rate [°/s]", body_pitch_rate_deg_s: "pitch rate [°/s]", body_yaw_rate_deg_s: "yaw rate of the body [°/s]",
};

// When each decision's frame was taken, and when its command moved the motors [s].
function spans(flight) {
  const sent = numbers(flight.commands.sent);
  const parts = ["t1", "wait", "t2", "send"].map((key) => flight.stages[key]).filter(Boolean);
  const whole = flight.stages.end_to_end;
  return sent.map((at, i) => {
    const taken = at - parts.reduce((sum, part) => sum + (part[i] ?? 0), 0) / 1000;
    return { sent: at, taken, acts: whole && whole[i] !== null ? taken + whole[i] / 1000 : at };
  });
}

function makeTracks(goTo) {
  const box = document.getElementById("tracks");
  const plot = document.getElementById("tracks-plot");
  let drawn = false;

  function rows(flight) {
    const time = numbers(flight.time);
    const line = (y, name, colour, more = {}) => ({
      x: time, y, name, mode: "lines", line: { color: colour, width: 1.5, ...more }, hovertemplate: `%{y:.2f} ${name}<extra></extra>`,
    });
    const held = (key) => {
      const x = numbers(flight.commands.sent);
      const y = numbers(flight.commands[key]);
      if (!x.length) return [];
      const end = Math.max(time[time.length - 1], x[x.length - 1]);
      return [{ ...line([...y, y[y.length - 1]], "commanded", COLOURS.commanded, { shape: "hv" }), x: [...x, end] }];
    };
    const both = (key, estimated = true) => [
      line(numbers(flight.flown[key]), "flown", COLOURS.flown),
      ...(estimated && flight.estimated ? [line(numbers(flight.estimated[key]), "estimated", COLOURS.estimated, { dash: "dash", width: 1.2 })] : []),
    ];
    const commanded = Object.keys(flight.commands).filter((key) => key !== "sent");
    const list = [...new Set(["forward_m_s", "right_m_s", ...commanded])].map((key) => [TITLES[key], [
      ...(flight.flown[key] ? both(key, key !== "yaw_rate_deg_s" && Boolean(flight.estimated?.[key])) : []),
      ...(flight.commands[key] ? held(key) : []),
    ]]);
    const height = both("height_m");
    if (flight.altitude !== null) {
      height.push({ ...line([flight.altitude, flight.altitude], "commanded", COLOURS.commanded), x: [Math.max(0, time[0]), time[time.length - 1]] });
    }
    list.push(["height [m]", height]);
    if (!flight.commands.roll_deg) list.push(["attitude [°]: roll, and pitch dotted", [
      line(numbers(flight.flown.roll_deg), "roll", COLOURS.flown),
      line(numbers(flight.flown.pitch_deg), "pitch", COLOURS.flown, { dash: "dot" }),
      ...(flight.estimated ? [
        line(numbers(flight.estimated.roll_deg), "roll, estimated", COLOURS.estimated, { dash: "dash", width: 1 }),
        line(numbers(flight.estimated.pitch_deg), "pitch, estimated", COLOURS.estimated, { dash: "dot", width: 1 }),
      ] : []),
    ]]);
    if (flight.errors) {
      list.push(["error of estimate: aside, height dotted [m]; dashed [m/s]", [
        line(numbers(flight.errors.aside_m), "m aside", COLOURS.estimated),
        line(numbers(flight.errors.height_m), "m of height", COLOURS.estimated, { dash: "dot" }),
        line(numbers(flight.errors.velocity_m_s), "m/s", COLOURS.other, { dash: "dash" }),
      ]]);
    }
    if (flight.power) list.push(["power without the computer [W]", [line(numbers(flight.power), "W", COLOURS.flown)]]);
    if (flight.motors) {
      list.push(["motor outputs: front right, rear left; dotted: front left, rear right", ["front right", "rear left", "front left", "rear right"]
        .map((corner, i) => line(numbers(flight.motors[i]), corner, i % 2 ? COLOURS.other : COLOURS.flown, i < 2 ? { width: 1 } : { width: 1, dash: "dot" }))]);
    }
    const decisions = spans(flight);
    if (decisions.length) {
      const x = [], y = [];
      decisions.forEach(({ taken, acts }, i) => {
        const until = decisions[i + 1]?.acts ?? time[time.length - 1];
        x.push(acts, Math.max(acts, until));
        y.push(1000 * (acts - taken), 1000 * (Math.max(acts, until) - taken));
      });
      const told = decisions.map((_, i) => Object.entries(flight.stages)
        .map(([key, values]) => `${key.replaceAll("_", " ")} ${values[i] ?? "–"}`).join("<br>"));
      list.push(["age of the flown command [ms]; points: t2, click for the view", [
        { x, y, name: "age", mode: "lines", line: { color: COLOURS.commanded, width: 1.2 }, hovertemplate: "%{y:.0f} ms old<extra></extra>" },
        {
          x: decisions.map(({ sent }) => sent), y: flight.stages.t2 ?? [], name: "t2", mode: "markers", text: told,
          marker: { size: 6, color: COLOURS.other }, hovertemplate: "%{text}<extra>ms</extra>",
        },
      ]]);
    }
    return list;
  }
  async function show(flight, seconds) {
    box.hidden = false;
    const ink = getComputedStyle(document.body).color;
    const list = rows(flight);
    const high = 1 / list.length;
    const layout = {
      font: { color: ink, size: 11 }, paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)",
      modebar: { bgcolor: "rgba(0,0,0,0)", color: "#5c646e", activecolor: "#2f7fc4" },
      margin: { l: 42, r: 12, t: 6, b: 36 }, showlegend: false, hovermode: "x", dragmode: "zoom", annotations: [],
      xaxis: { title: { text: "time since the start of navigation [s]" }, gridcolor: "#8d969f33", zerolinecolor: "#8d969f88", anchor: `y${list.length}`, range: [Math.max(numbers(flight.time)[0], -1), numbers(flight.time).at(-1)], showspikes: true, spikemode: "across", spikethickness: 1, spikedash: "dot" },
      shapes: flight.faults.map(([from, to]) => ({ type: "rect", xref: "x", yref: "paper", x0: from, x1: to, y0: 0, y1: 1, fillcolor: "#cf6a1222", line: { width: 0 } })),
    };
    layout.shapes.push({ type: "line", xref: "x", yref: "paper", x0: seconds, x1: seconds, y0: 0, y1: 1, line: { color: "#8d969f", width: 1 } });
    const data = list.flatMap(([title, lines], k) => {
      const top = 1 - k * high;
      layout[`yaxis${k + 1}`] = { domain: [top - high + 0.008, top - 0.25 * high], gridcolor: "#8d969f33", zeroline: false, fixedrange: true, nticks: 5 };
      layout.annotations.push({ text: title, xref: "paper", yref: "paper", x: 0, y: top - 0.02 * high, xanchor: "left", yanchor: "top", showarrow: false, font: { size: 11 } });
      return lines.map((line) => ({ type: "scatter", yaxis: `y${k + 1}`, ...line }));
    });
    plot.style.height = `${60 + 112 * list.length}px`;
    await Plotly.newPlot(plot, data, layout, { responsive: true, displaylogo: false, displayModeBar: innerWidth > 600, doubleClick: "reset+autosize", modeBarButtonsToRemove: ["select2d", "lasso2d", "autoScale2d"] });
    plot.removeAllListeners?.("plotly_click");
    plot.on("plotly_click", (event) => goTo(event.points[0].x));
    drawn = true;
  }
  function move(seconds) {
    if (!drawn) return null;
    const last = plot.layout.shapes.length - 1;
    return Plotly.relayout(plot, { [`shapes[${last}].x0`]: seconds, [`shapes[${last}].x1`]: seconds });
  }
  return { show, move };
}
