// Speed and torque of a run over one time axis: zoom, pan, values under the cursor, export of the view.
"use strict";
(() => {
  const { fixed, tick, tr, word } = window.tdhilLanguage;
  const { axis, byId, colour, el, inSpeedUnit, onSpeedUnit, speedUnit } = window.tdhil;
  const HEIGHT = 190;
  const LEAST_S = 0.2;           // shortest view: five displayed samples
  const DRAG_PX = 6;             // a shorter drag is a click
  const NAMES_PX = 18;           // room for the names of the stages above a chart
  const STEP = 0.25, ZOOM = 2;   // a press of a button moves by a quarter of the view, or halves it
  const HINT = tr("Drag across a chart to zoom. Double-click shows the whole run.");

  /** Nearest index of `time` to `at`; `time` rises. */
  function nearest(time, at) {
    let low = 0, high = time.length - 1;
    while (high - low > 1) {
      const middle = (low + high) >> 1;
      if (time[middle] < at) low = middle; else high = middle;
    }
    return at - time[low] < time[high] - at ? low : high;
  }

  /** Values of a chart under the cursor, in a line below it. `describe` takes a place on the x axis. Return parts of uPlot's options. */
  function reading(where, describe) {
    const hint = tr("Move over the chart to read its values."), line = el("p", { class: "readout dim" }, hint);
    where.after(line);
    return {
      cursor: { points: { show: false } },
      setCursor: [(self) => {
        const text = self.cursor.left >= 0 ? describe(self.posToVal(self.cursor.left, "x")) : hint;
        if (line.textContent !== text) line.textContent = text;
      }],
    };
  }

  function save(name, blob) {
    const href = URL.createObjectURL(blob);
    el("a", { href, download: name }).click();
    setTimeout(() => URL.revokeObjectURL(href), 10000);
  }

  /**
   * The view of charts over one x axis: zoom, pan, export as PNG and CSV. `charts`: [{ where, plot, title }], where
   * `title` returns a text; `tools`: the toolbar; `whole` returns the whole range, `least` is the narrowest view;
   * `table` returns the lines of a range, `file` the name of its file. Return the range, and parts of uPlot's options.
   */
  function viewOf(charts, { tools, whole, least, table, file }) {
    let view = null;
    const range = () => view || whole();
    /** Show a part; null shows all, and follows a live run. */
    function look(next) {
      if (next) {
        const [first, last] = whole();
        const width = Math.min(Math.max(next[1] - next[0], least), last - first);
        const from = Math.min(Math.max(next[0], first), last - width);
        next = width >= last - first ? null : [from, from + width];
      }
      view = next;
      const [low, high] = range();
      for (const chart of charts) chart.plot.setScale("x", { min: low, max: high });
      for (const one of tools.querySelectorAll("[data-part]")) one.disabled = !view;
    }
    function zoom(factor, at) {
      const [low, high] = range(), middle = at ?? (low + high) / 2;
      look([middle - (middle - low) / factor, middle + (high - middle) / factor]);
    }
    function pan(share) {
      const [low, high] = range(), by = share * (high - low);
      look([low + by, high + by]);
    }
    /** All charts as one picture, as they are on the screen. */
    function picture() {
      const parts = charts.map((chart) => ({ canvas: chart.plot.ctx.canvas, title: chart.title() }));
      const px = devicePixelRatio, above = 22 * px, paper = el("canvas"), c = paper.getContext("2d");
      paper.width = parts[0].canvas.width;
      paper.height = parts.reduce((sum, one) => sum + one.canvas.height + above, 0);
      c.fillStyle = colour("--ground");
      c.fillRect(0, 0, paper.width, paper.height);
      c.fillStyle = colour("--ink");
      c.font = `${13 * px}px system-ui, sans-serif`;
      let y = 0;
      for (const one of parts) {
        c.fillText(one.title, 8 * px, y + 15 * px);
        c.drawImage(one.canvas, 0, y + above);
        y += one.canvas.height + above;
      }
      paper.toBlob((blob) => save(`${file(range())}.png`, blob));
    }
    const csv = () => save(`${file(range())}.csv`, new Blob([`${table(range()).join("\n")}\n`], { type: "text/csv" }));
    const does = { in: () => zoom(ZOOM), out: () => zoom(1 / ZOOM), back: () => pan(-STEP), on: () => pan(STEP), whole: () => look(null), png: picture, csv };
    for (const one of tools.querySelectorAll("[data-tool]")) one.addEventListener("click", does[one.dataset.tool]);
    for (const chart of charts) chart.where.addEventListener("wheel", (event) => {          // a wheel alone scrolls the page
      const sideways = event.shiftKey ? event.deltaY || event.deltaX : event.deltaX;
      if (event.ctrlKey) zoom(event.deltaY < 0 ? ZOOM ** 0.5 : ZOOM ** -0.5, chart.plot.posToVal(event.clientX - chart.plot.over.getBoundingClientRect().left, "x"));
      else if (Math.abs(sideways) > Math.abs(event.shiftKey ? 0 : event.deltaY)) pan(Math.sign(sideways) * STEP / 4);
      else return;
      event.preventDefault();
    }, { passive: false });
    return {
      range, look, again: () => look(view),
      cursor: { y: false, drag: { x: true, y: false, setScale: false, dist: DRAG_PX }, bind: { dblclick: () => () => look(null) } },
      setSelect: [(self) => {
        const { left, width } = self.select;
        if (width < DRAG_PX) return;
        const part = [self.posToVal(left, "x"), self.posToVal(left + width, "x")];
        self.setSelect({ left: 0, top: 0, width: 0, height: 0 }, false);
        look(part);
      }],
    };
  }

  /** Make the toolbar of a chart, below it and its values. `label` names the chart. */
  function toolbar(where, label) {
    const button = (tool, text, name, part = true) => el("button", { type: "button", class: "quiet", "data-tool": tool, "data-part": part, "aria-label": name }, text);
    const found = el("div", { class: "row tools", role: "toolbar", "aria-label": tr("View: {chart}", { chart: label }) },
      button("in", "+", tr("Zoom in"), false), button("out", "−", tr("Zoom out")), button("back", "◀", tr("To the left")), button("on", "▶", tr("To the right")),
      button("whole", tr("Whole"), null), button("png", "PNG", null, false), button("csv", "CSV", null, false));
    (where.nextElementSibling?.matches(".readout") ? where.nextElementSibling : where).after(found);
    return found;
  }

  /** Charts of the live page. `set` takes [time s, speed rad/s, torque N·m]; `limit` the guard's limits; `stages` [{name, end_s}]. */
  function motion(run) {
    const readout = byId("readout");
    let samples = [[], [], []], limits = null, stages = [];
    const title = (chart) => () => chart.where.parentElement.querySelector("figcaption").textContent;
    const charts = [
      { where: byId("plot-speed"), column: 1, colour: "--speed", shown: inSpeedUnit, of: (one) => [one.speed_min_rad_s, one.speed_max_rad_s] },
      { where: byId("plot-torque"), column: 2, colour: "--torque", shown: (one) => one, of: (one) => [-one.torque_nm, one.torque_nm] },
    ];
    for (const chart of charts) chart.title = title(chart);
    const limitsOf = (chart) => (limits ? chart.of(limits).filter((one) => one !== null).map(chart.shown) : []);
    const view = viewOf(charts, {
      tools: byId("view-tools"), least: LEAST_S, whole: () => [samples[0][0] ?? 0, samples[0][samples[0].length - 1] ?? 1],
      file: (range) => `${run}-${range.map((one) => `${Math.round(one)}s`).join("-")}`,
      table: ([low, high]) => ["time_s,speed_rad_s,torque_nm", ...samples[0].flatMap((at, k) => (at >= low && at <= high ? [[at, samples[1][k] ?? "", samples[2][k] ?? ""].join(",")] : []))],
    });

    function read(at) {
      const text = at === null || !samples[0].length ? HINT : (() => {
        const k = nearest(samples[0], at), speed = samples[1][k], torque = samples[2][k];
        const value = (one, digits) => (one === null ? tr("no value") : fixed(one, digits));
        return `${fixed(samples[0][k], 2)} s: ${value(speed === null ? null : inSpeedUnit(speed), 3)} ${speedUnit()}, ${value(torque, 1)} N·m`;
      })();
      if (readout.textContent !== text) readout.textContent = text;
    }

    function marks(chart, self) {
      const c = self.ctx, px = devicePixelRatio, { left, top, width, height } = self.bbox;
      c.save();
      c.font = `${11 * px}px system-ui, sans-serif`;
      c.textAlign = "left";
      c.textBaseline = "bottom";
      c.fillStyle = colour("--dim");
      let from = samples[0][0] ?? 0;
      if (chart.column === 1) for (const stage of stages) {          // above the chart, where no curve crosses the names
        const name = word(stage.name, "stage"), after = Math.min(self.valToPos(stage.end_s, "x", true), left + width), before = Math.max(self.valToPos(from, "x", true), left);
        if (after - before > c.measureText(name).width + 4 * px) c.fillText(name, before + 4 * px, top - 3 * px);
        from = stage.end_s;
      }
      c.beginPath(); c.rect(left, top, width, height); c.clip();
      c.lineWidth = px;
      c.strokeStyle = colour("--line");
      for (const stage of stages) {
        const x = self.valToPos(stage.end_s, "x", true);
        c.beginPath(); c.moveTo(x, top); c.lineTo(x, top + height); c.stroke();
      }
      c.strokeStyle = colour("--limit");
      c.lineWidth = 1.5 * px;
      c.setLineDash([6 * px, 4 * px]);
      for (const value of limitsOf(chart)) {
        const y = self.valToPos(value, "y", true);
        c.beginPath(); c.moveTo(left, y); c.lineTo(left + width, y); c.stroke();
      }
      c.restore();
    }

    /** Columns of a chart. Only speeds in rpm need a copy: this runs as long as samples come. */
    const data = (chart) => [samples[0], chart.column === 1 && inSpeedUnit(1) !== 1 ? samples[1].map((one) => (one === null ? null : inSpeedUnit(one))) : samples[chart.column]];
    function draw() {
      for (const chart of charts) {
        if (chart.plot) chart.plot.destroy();
        chart.plot = new uPlot({
          width: chart.where.clientWidth || 320, height: HEIGHT, legend: { show: false }, padding: [chart.column === 1 ? NAMES_PX : null, null, null, null],
          cursor: { ...view.cursor, sync: { key: "motion" } },
          scales: {
            x: { time: false, range: () => view.range() },
            y: { range: (self, low, high) => {
              const all = [low, high, ...limitsOf(chart)].filter((one) => Number.isFinite(one));
              const from = Math.min(0, ...all), to = all.length ? Math.max(...all, from + 1e-3) : from + 1, pad = 0.06 * (to - from);
              return [from - pad, to + pad];
            } },
          },
          axes: [axis({ size: 34, values: (self, all) => all.map((one) => `${tick(one)} s`) }), axis({ size: 52 })],
          series: [{}, { stroke: colour(chart.colour), width: 1.5, points: { show: false } }],
          hooks: {
            draw: [(self) => marks(chart, self)],
            setCursor: [(self) => { if (self.cursor.event) read(self.cursor.left >= 0 ? self.posToVal(self.cursor.left, "x") : null); }],
            setSelect: view.setSelect,
          },
        }, data(chart), chart.where);
        chart.plot.over.addEventListener("mouseleave", () => read(null));
      }
      view.again();
    }

    for (const chart of charts) new ResizeObserver(() => chart.plot.setSize({ width: chart.where.clientWidth || 320, height: HEIGHT })).observe(chart.where);

    draw();
    read(null);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);
    onSpeedUnit(draw);
    return {
      set: (found) => { samples = found; for (const chart of charts) chart.plot.setData(data(chart)); },
      limit: (found) => { limits = found; for (const chart of charts) chart.plot.setData(data(chart)); },
      stages: (found) => { stages = found; for (const chart of charts) chart.plot.redraw(false); },
    };
  }

  Object.assign(window.tdhil, { motion, nearest, reading, toolbar, viewOf });
})();
