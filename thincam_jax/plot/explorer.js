// Controls and pictures, in a notebook and on the pages of `thincam explore` and `thincam preview`.
// `request(values, rest)` resolves to a header and the pictures, as `View.message` makes them.

const STYLE = `
.tc-explorer { font: 14px/1.4 system-ui, sans-serif; color: CanvasText; background: Canvas; color-scheme: light dark; }
.tc-controls { display: grid; grid-template-columns: repeat(auto-fill, minmax(250px, 1fr)); gap: .2rem 1.4rem; margin-bottom: .8rem; }
.tc-controls label { display: grid; grid-template-columns: 1fr auto; align-items: baseline; }
.tc-controls input { grid-column: 1 / 3; width: 100%; margin: 0; }
.tc-controls output { font-variant-numeric: tabular-nums; }
.tc-pictures { display: grid; grid-template-columns: repeat(auto-fit, minmax(240px, 1fr)); gap: 1rem; }
.tc-pictures figure { margin: 0; }
.tc-pictures img, .tc-pictures canvas { width: 100%; aspect-ratio: 1; object-fit: contain; background: #000; display: block; }
.tc-pictures canvas { background: #fff; }
.tc-pictures figcaption { font-size: 13px; margin-top: .2rem; }
.tc-pictures img:not([src]) { visibility: hidden; }
.tc-empty { position: relative; }
.tc-empty::before { content: attr(data-wait); position: absolute; inset: 0 0 auto; aspect-ratio: 1; display: grid; place-items: center; outline: 1px solid #999; }
.tc-empty canvas { visibility: hidden; }
.tc-stale { opacity: .45; }
.tc-lines { margin: .8rem 0 0; min-height: 2.8em; }`;

const CAPTIONS = {
  psf: "PSF, black to its maximum",
  transfer: "transfer function of one capture, |H| along u (cycles/mm)",
  capture: "raw capture, stretched",
  image: "reconstruction",
};

function element(kind, parent, properties = {}) {
  return parent.appendChild(Object.assign(document.createElement(kind), properties));
}

function digits(value) {
  return Number(value.toPrecision(4)).toString();
}

// At most two requests on their way; of those that wait only the newest is sent. At rest, a moment
// after the last move, one with all pictures follows.
// What is live is asked for again as soon as an answer is there.
function scheduler(request, show, live) {
  let flying = 0, waiting = null, pause = null, sent = 0, shown = 0, latest = null;
  async function send(values, rest) {
    const number = ++sent;
    flying += 1;
    try {
      const answer = await request(values, rest);
      if (number > shown) {
        shown = number;
        show(...answer);
      }
    } catch (error) {
      live = false;
      show({ names: [], transfer: [], lines: [error.message], values: {} }, []);
    } finally {
      flying -= 1;
      if (waiting) {
        const next = waiting;
        waiting = null;
        send(...next);
      } else if (live && !flying) {
        send(latest, false);
      }
    }
  }
  function ask(values, rest) {
    if (flying < 2) send(values, rest);
    else waiting = [values, rest];
  }
  return (values, keep = false) => {
    latest = { ...values };
    ask(latest, keep);
    clearTimeout(pause);
    if (!live) pause = setTimeout(() => ask(latest, true), 250);
  };
}

function draw(canvas, header) {
  const ratio = window.devicePixelRatio || 1;
  const side = Math.max(200, canvas.clientWidth), left = 34, bottom = 24, right = side - 10;
  canvas.width = canvas.height = side * ratio;
  const pen = canvas.getContext("2d");
  pen.scale(ratio, ratio);
  const last = header.transfer.length * header.step;
  const end = header.cut_off ? Math.min(last, 1.25 * header.cut_off) : last;
  const top = Math.max(1, ...header.transfer) * 1.25; // room for names
  const x = (u) => left + (right - left) * (u / end);
  const y = (level) => side - bottom - (side - bottom) * (level / top);
  pen.font = "12px system-ui, sans-serif";
  pen.fillStyle = "#222";
  pen.strokeStyle = "#ccc";
  for (const level of [0, 0.5, 1]) {
    pen.strokeRect(left, y(level), right - left, 0);
    pen.fillText(level.toString(), 6, y(level) + 4);
  }
  const step = Number((end / 4).toPrecision(1));
  pen.textAlign = "center";
  for (let u = 0; u <= end; u += step) pen.fillText(digits(u), x(u), side - 7);
  pen.strokeStyle = "#1060a0";
  pen.lineWidth = 1.5;
  pen.beginPath();
  header.transfer.forEach((level, index) => {
    const u = (index + 1) * header.step;
    if (u <= end) pen.lineTo(x(u), y(level));
  });
  pen.stroke();
  pen.strokeStyle = "#222";
  pen.lineWidth = 1;
  pen.setLineDash([5, 4]);
  [["zero", header.zero], ["cut-off", header.cut_off]].forEach(([name, u], row) => {
    if (!u || u > end) return;
    pen.strokeRect(x(u), 20 + 15 * row, 0, y(0) - 20 - 15 * row);
    pen.textAlign = x(u) > side / 2 ? "right" : "left";
    pen.fillText(`${name} ${digits(u)}`, x(u), 15 + 15 * row);
  });
}

export function mount(root, controls, request, captions = null, live = false) {
  const place = element("div", root, { className: "tc-explorer" });
  element("style", place, { textContent: STYLE });
  const knobs = element("div", place, { className: "tc-controls" });
  const pictures = element("div", place, { className: "tc-pictures" });
  const lines = element("p", place, { className: "tc-lines", ariaLive: "polite" });
  const values = {}, shown = {}, addresses = {};
  const brief = live ? "waiting for the camera…" : "compiling…"; // in a panel still empty
  const filled = (name) => shown[name].parentElement.classList.remove("tc-empty");
  for (const [name, caption] of Object.entries(captions ?? CAPTIONS)) {
    const figure = element("figure", pictures, { className: "tc-empty" });
    figure.dataset.wait = brief;
    shown[name] = element(name === "transfer" ? "canvas" : "img", figure, { alt: caption });
    element("figcaption", figure, { textContent: caption });
  }
  // What takes long is said until its answer comes.
  const wait = live ? "Waiting for the next frame…" : "Computing…";
  const told = `${wait} A first reconstruction is compiled, which can take a minute.`;
  async function patient(values, rest) {
    const pause = setInterval(() => {
      if (lines.textContent !== told) lines.textContent = told;
    }, live ? 3000 : 700);
    return request(values, rest).finally(() => clearInterval(pause));
  }
  const turn = scheduler(patient, (header, blobs) => {
    header.names.forEach((name, index) => {
      URL.revokeObjectURL(addresses[name]);
      addresses[name] = URL.createObjectURL(blobs[index]);
      shown[name].src = addresses[name];
      filled(name);
    });
    for (const name of Object.keys(shown)) {
      if (!header.names.length) shown[name].parentElement.dataset.wait = ""; // an error, told below
      const stale = !header.names.includes(name) && !["psf", "transfer"].includes(name);
      shown[name].classList.toggle("tc-stale", stale);
    }
    if (header.transfer.length) {
      draw(shown.transfer, header);
      filled("transfer");
    }
    lines.textContent = header.lines.join(" ");
    place.dataset.values = JSON.stringify(header.values);
    place.dataset.count = Number(place.dataset.count ?? 0) + 1;
  }, live);
  for (const control of controls) {
    const { name, label, unit, low, high, value } = control;
    values[name] = value;
    const row = element("label", knobs);
    element("span", row, { textContent: label });
    const shown = element("output", row, { textContent: `${digits(value)} ${unit}` });
    const slider = element("input", row, { type: "range", min: low, max: high, step: "any", value });
    slider.name = name;
    slider.addEventListener("input", () => {
      values[name] = slider.valueAsNumber;
      shown.textContent = `${digits(values[name])} ${unit}`;
      turn(values);
    });
  }
  if (live) {
    const keep = element("button", knobs, { textContent: "keep this frame (k)" });
    keep.addEventListener("click", () => turn(values, true));
    document.addEventListener("keydown", ({ key }) => key === "k" && turn(values, true));
  }
  turn(values);
  return place;
}

function byModel(model) {
  const answers = new Map();
  let last = 0;
  model.on("msg:custom", ({ id, header }, buffers) => {
    const blobs = buffers.map((buffer) => new Blob([buffer]));
    answers.get(id)?.([JSON.parse(header), blobs]);
    answers.delete(id);
  });
  return (values, rest) =>
    new Promise((resolve) => {
      answers.set(++last, resolve);
      model.send({ id: last, values, rest });
    });
}

// The server's answer: the lengths of the header and of each picture, then all of them.
export function byFetch(address, token) {
  return async (values, rest) => {
    const answer = await fetch(address, {
      method: "POST",
      headers: { Authorization: `Bearer ${token}`, "Content-Type": "application/json" },
      body: JSON.stringify({ values, rest }),
    });
    if (!answer.ok) throw new Error(await answer.text());
    const lengths = answer.headers.get("X-Lengths").split(",").map(Number);
    const body = await answer.blob();
    let start = 0;
    const [header, ...blobs] = lengths.map((length) => body.slice(start, (start += length)));
    return [JSON.parse(await header.text()), blobs];
  };
}

export default {
  render({ model, el }) {
    mount(el, model.get("controls"), byModel(model));
  },
};
