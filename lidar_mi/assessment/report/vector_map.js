// Vectors of a wind field to be looked at one by one: hover, click or tap to pin, or arrow keys. Needs nothing else.
(() => {
  "use strict";
  const grey = "#bbb";
  // viridis and a diverging map, sampled; colours between are linear
  const speeds = [[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]];
  const errors = [[33, 102, 172], [103, 169, 207], [215, 215, 215], [239, 138, 98], [178, 24, 43]];

  function colour(scale, fraction) {
    const at = Math.min(Math.max(fraction, 0), 1) * (scale.length - 1), k = Math.min(Math.floor(at), scale.length - 2);
    return "rgb(" + scale[k].map((c, i) => Math.round(c + (at - k) * (scale[k + 1][i] - c))).join() + ")";
  }

  function highest(values, quantile) {
    const known = values.filter(v => v !== null).map(Math.abs).sort((a, b) => a - b);
    return known.length ? known[Math.floor(quantile * (known.length - 1))] || 1 : 1;
  }

  function start(box) {
    const data = JSON.parse(box.querySelector("script").textContent);
    const canvas = box.querySelector("canvas"), choice = box.querySelector("select");
    const flagged = box.querySelector("input"), key = box.querySelector(".key");
    const rows = box.querySelector("tbody"), where = box.querySelector(".where");
    const part = Object.fromEntries(data.components.map(c => [c.name, c]));
    const { v, w } = part, many = data.y.length;
    const difference = c => c.retrieved.map((f, k) => f === null || c.true[k] === null ? null : f - c.true[k]);
    const speed = v.retrieved.map((f, k) => f === null || w.retrieved[k] === null ? null : Math.hypot(f, w.retrieved[k]));
    const valid = values => values.filter((_, k) => data.flag[k] === 0);
    const fastest = highest([...valid(speed), ...v.true.map((f, k) => f === null ? null : Math.hypot(f, w.true[k]))], 0.995);
    const shown = [{ label: "speed of v and w", values: speed, scale: speeds, low: 0, high: fastest }];
    for (const c of data.components) {
      const off = difference(c), top = highest(valid(off), 0.98);
      shown.push({ label: "error of " + c.name, values: off, scale: errors, low: -top, high: top });
    }
    if (part.u) {
      // all one way: of its own range
      const known = valid(part.u.retrieved).filter(u => u !== null), top = highest(known, 0.995);
      const least = Math.min(...known), most = Math.max(...known), oneWay = least > 0 || most < 0;
      shown.push({ label: "u", values: part.u.retrieved, scale: oneWay ? speeds : errors,
        low: oneWay ? least : -top, high: oneWay ? most : top });
    }
    shown.forEach((s, k) => choice.add(new Option(s.label, k)));
    choice.value = Math.max(0, shown.findIndex(s => s.label === data.colour));

    const half = data.step / 2;
    const left = Math.max(...data.y) + half, right = Math.min(...data.y) - half;
    const top = Math.max(...data.z) + half, bottom = Math.min(...data.z) - half;
    let chosen = -1, pinned = false, width = 0, height = 0, unit = 1;

    const edge = 46, foot = 40;  // px for the axes, left and below
    const px = (y, z) => [edge + (left - y) * unit, (top - z) * unit];

    // 1, 2 or 5 times a power of ten, at most a length
    function round(length) {
      const power = 10 ** Math.floor(Math.log10(length));
      return [5, 2, 1].find(n => n * power <= length) * power;
    }

    function frame(pen) {
      const right = edge + (left - (Math.min(...data.y) - half)) * unit;
      pen.strokeStyle = pen.fillStyle = "#444";
      pen.lineWidth = 1;
      pen.font = "12px system-ui, sans-serif";
      pen.strokeRect(edge + 0.5, 0.5, right - edge - 1, height - foot);
      const gap = round(Math.max(1e-9, (left - (Math.min(...data.y) - half)) / 4));
      const ticks = (low, high) => Array.from(
        { length: Math.floor(high / gap) - Math.ceil(low / gap) + 1 }, (_, k) => (Math.ceil(low / gap) + k) * gap);
      const text = value => String(+value.toPrecision(6)).replace("-", "\u2212");
      pen.textAlign = "center";
      for (const y of ticks(Math.min(...data.y) - half, left)) {
        const x = px(y, 0)[0];
        pen.fillRect(x, height - foot, 1, 5);
        pen.fillText(text(y), x, height - foot + 18);
      }
      pen.fillText("y / m", (edge + right) / 2, height - 6);
      pen.textAlign = "right";
      for (const z of ticks(bottom, top)) {
        const up = px(0, z)[1];
        pen.fillRect(edge - 5, up, 5, 1);
        if (up > 8) pen.fillText(text(z), edge - 8, up + 4);
      }
      pen.save();
      pen.rotate(-Math.PI / 2);
      pen.textAlign = "center";
      pen.fillText("z / m", -(height - foot) / 2, 12);
      pen.restore();
      // how long an arrow is
      const speed = round(fastest), long = 1.6 * data.step * unit * speed / fastest;
      pen.strokeStyle = "#000";
      pen.lineWidth = 2;
      pen.beginPath();
      pen.moveTo(right - long, height - 10); pen.lineTo(right, height - 10);
      pen.lineTo(right - 4, height - 13); pen.moveTo(right, height - 10); pen.lineTo(right - 4, height - 7);
      pen.stroke();
      pen.textAlign = "right";
      pen.fillText(text(speed) + " m/s", right - long - 6, height - 6);
    }

    function arrow(pen, y, z, v, w) {
      // a step and a half long at the fastest; port is on the left
      const long = 1.6 * data.step * unit / fastest, [x0, y0] = px(y, z);
      const dx = -v * long, dy = -w * long, size = Math.hypot(dx, dy), head = Math.min(4, 0.4 * size);
      const a = Math.atan2(dy, dx);
      pen.beginPath();
      pen.moveTo(x0, y0);
      pen.lineTo(x0 + dx, y0 + dy);
      for (const turn of [2.6, -2.6]) {
        pen.moveTo(x0 + dx, y0 + dy);
        pen.lineTo(x0 + dx + head * Math.cos(a + turn), y0 + dy + head * Math.sin(a + turn));
      }
      pen.stroke();
    }

    function draw() {
      width = canvas.clientWidth;
      unit = (width - edge - 1) / (left - right);
      height = Math.round((top - bottom) * unit) + foot;
      canvas.style.height = height + "px";
      const dense = window.devicePixelRatio || 1;
      canvas.width = width * dense;
      canvas.height = height * dense;
      const pen = canvas.getContext("2d"), what = shown[choice.value];
      pen.scale(dense, dense);
      frame(pen);
      pen.lineWidth = Math.max(1, unit * data.step / 12);
      for (let k = 0; k < many; k++) {
        if (v.retrieved[k] === null || w.retrieved[k] === null) continue;
        if (data.flag[k] !== 0 && !flagged.checked) continue;
        const value = what.values[k], fraction = (value - what.low) / (what.high - what.low);
        pen.strokeStyle = data.flag[k] !== 0 || value === null ? grey : colour(what.scale, fraction);
        arrow(pen, data.y[k], data.z[k], v.retrieved[k], w.retrieved[k]);
      }
      pen.strokeStyle = "crimson";
      pen.lineWidth = 1.5;
      for (const [y, z] of data.cores) {
        const [x, up] = px(y, z);
        pen.beginPath();
        pen.moveTo(x - 6, up); pen.lineTo(x + 6, up); pen.moveTo(x, up - 6); pen.lineTo(x, up + 6);
        pen.stroke();
      }
      if (chosen >= 0) {
        const [x, up] = px(data.y[chosen], data.z[chosen]);
        pen.strokeStyle = "#000";
        pen.beginPath();
        pen.lineWidth = pinned ? 3 : 1.5;
        pen.arc(x, up, 7, 0, 7);
        pen.stroke();
        pen.strokeStyle = "#d62728";
        pen.lineWidth = 1.5;
        if (v.true[chosen] !== null) arrow(pen, data.y[chosen], data.z[chosen], v.true[chosen], w.true[chosen]);
      }
      key.style.background = "linear-gradient(to right," + what.scale.map(c => "rgb(" + c + ")") + ")";
      box.querySelector(".low").textContent = what.low.toFixed(1);
      box.querySelector(".high").textContent = what.high.toFixed(1) + " m/s";
    }

    function show(k) {
      if (k < 0) return;
      chosen = k;
      const number = value => value === null || value === undefined ? "\u2013" : value.toFixed(2).replace("-0.00", "0.00");
      const reasons = Object.entries(data.flags).filter(([mask]) => data.flag[k] & mask).map(([, text]) => text);
      where.textContent = "y = " + data.y[k].toFixed(1) + " m, z = " + data.z[k].toFixed(1) + " m: " +
        (reasons.length ? "rejected, " + reasons.join(", ") : "valid") +
        ", v " + number(v.retrieved[k]) + ", w " + number(w.retrieved[k]) + " m/s" + (pinned ? ", pinned" : "");
      rows.replaceChildren(...data.components.map(c => {
        const row = document.createElement("tr"), f = c.retrieved[k], t = c.true[k];
        const off = f === null || t === null ? null : f - t;
        for (const text of [c.name, number(f), number(t), number(off), number(c.stderr && c.stderr[k])]) {
          row.append(Object.assign(document.createElement("td"), { textContent: text }));
        }
        return row;
      }));
      draw();
    }

    const hidden = k => v.retrieved[k] === null || w.retrieved[k] === null || (data.flag[k] !== 0 && !flagged.checked);

    // the next one in a direction, however wide the gap: rather straight ahead than near
    function next(y, z) {
      let best = -1, least = Infinity;
      for (let k = 0; k < many; k++) {
        if (hidden(k)) continue;
        const dy = data.y[k] - data.y[chosen], dz = data.z[k] - data.z[chosen];
        const ahead = y * dy + z * dz, aside = Math.abs(y * dz - z * dy);
        if (ahead < data.step / 2) continue;
        const far = ahead + 3 * aside;
        if (far < least) { least = far; best = k; }
      }
      return best;
    }

    function nearest(y, z) {
      let best = -1, least = Infinity;
      for (let k = 0; k < many; k++) {
        if (hidden(k)) continue;
        const far = (data.y[k] - y) ** 2 + (data.z[k] - z) ** 2;
        if (far < least) { least = far; best = k; }
      }
      return best;
    }

    function at(event) {
      const box = canvas.getBoundingClientRect();
      return nearest(left - (event.clientX - box.left - edge) / unit, top - (event.clientY - box.top) / unit);
    }

    canvas.addEventListener("pointermove", event => {
      if (pinned) return;
      const k = at(event);
      if (k !== chosen) show(k);
    });
    canvas.addEventListener("click", event => {
      const k = at(event);
      pinned = !(pinned && k === chosen);
      show(k);
    });
    canvas.addEventListener("keydown", event => {
      if (event.key === "Escape" && pinned) { pinned = false; show(chosen); }
      const step = { ArrowLeft: [1, 0], ArrowRight: [-1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[event.key];
      if (!step || chosen < 0) return;
      event.preventDefault();
      const k = next(...step);
      if (k < 0) return;
      pinned = true;
      show(k);
    });
    choice.addEventListener("change", draw);
    flagged.addEventListener("change", draw);
    window.addEventListener("resize", draw);
    flagged.checked = !data.flag.some(bits => bits === 0);
    box.hidden = false;
    draw();
    const [y, z] = data.cores.length ? data.cores[0] : [0, 0];
    show(nearest(y, z + 4));
  }

  document.querySelectorAll(".map").forEach(start);
})();
