// Upload of a recording: the file, a preview with a mapping of its columns, and the run that is made from it.
"use strict";
(() => {
  const { english, errorText, local, tr, word } = window.tdhilLanguage;
  const { API, Refused, asked, axis, badge, byId, call, colour, csrf, el, inSpeedUnit, marked, number, onSpeedUnit, pages, refused, rehearsal, show, span, speedUnit, submits, unmark, waiting, when, whyOf } = window.tdhil;
  const QUANTITIES = ["time", "speed", "torque"];
  const BUSY = ["delayed", "identifying"];
  const HEIGHTS = [150, 180];  // of the charts, px; the lower one has the time axis with its label
  const LONG_MS = 600000;      // the preview of a large file, or a second one behind it
  const mebi = (bytes) => (bytes < 1e5 ? `${number(bytes / 1024, 2)} KiB` : `${number(bytes / 2 ** 20, 3)} MiB`);

  /** Send a file, with its progress. Return the promise of the upload, and a function that cancels it. */
  function send(file, progress) {
    const sender = new XMLHttpRequest();
    const found = new Promise((resolve, reject) => {
      sender.open("POST", `${API}/uploads?name=${encodeURIComponent(file.name)}`);
      for (const [name, value] of Object.entries({ "Content-Type": "application/octet-stream", ...csrf() })) sender.setRequestHeader(name, value);
      sender.upload.addEventListener("progress", (event) => progress(event.loaded, event.total));
      sender.addEventListener("abort", () => reject(new Refused(tr("The upload was cancelled. Nothing was kept."))));
      sender.addEventListener("error", () => reject(new Refused(tr("The upload was cut off. Nothing was kept."))));
      sender.addEventListener("load", () => {
        let body = {};
        try { body = JSON.parse(sender.responseText); } catch (error) { /* as of no answer */ }
        if (sender.status === 201) resolve(body);
        else reject(new Refused(body.error ? errorText(body.error) : `HTTP ${sender.status}`));
      });
      sender.send(file);
    });
    return { found, cancel: () => sender.abort() };
  }

  /** Two small charts over the same time, drawn again for another unit, width or colour scheme. */
  function plots(where, plot) {
    const [time, speed, torque] = plot, places = [el("div", { class: "mini" }), el("div", { class: "mini" })];
    let charts = [];
    const draw = () => {
      charts.forEach((one) => one.destroy());
      charts = [[speed.map((one) => (one === null ? null : inSpeedUnit(one))), speedUnit(), "--speed", tr("speed")], [torque, "N·m", "--torque", tr("torque")]].map(([values, unit, name, label], k) => new uPlot({
        width: where.clientWidth || 320, height: HEIGHTS[k], legend: { show: false }, cursor: { sync: { key: "preview" }, drag: { x: false, y: false } },
        scales: { x: { time: false } },
        axes: [axis({ size: k ? 40 : 24, ...(k ? { label: tr("time, s"), labelSize: 18 } : {}) }), axis({ size: 62, label: `${label}, ${unit}`, labelSize: 20 })],
        series: [{}, { stroke: colour(name), width: 1, points: { show: false } }],
      }, [time, values], places[k]));
    };
    show(where, ...places);
    draw();
    new ResizeObserver(() => charts.forEach((one, k) => one.setSize({ width: where.clientWidth || 320, height: HEIGHTS[k] }))).observe(where);
    return draw;
  }

  /** Length, rate, gaps, ranges and warnings of a reading. */
  function figures(reading) {
    const short = (value) => local(String(Number(value.toPrecision(3))));
    const range = (one, of = (value) => value) => (one ? tr("{low} to {high}", { low: short(of(one.min)), high: short(of(one.max)) }) : "–");
    const rows = [
      [tr("length"), span(reading.duration_s)], [tr("samples"), String(reading.samples)],
      [tr("rate"), reading.rate_hz === null ? "–" : `${number(reading.rate_hz, 3)} Hz`],
      [tr("gaps in the time"), reading.gaps ? tr("{count}, the widest of {width} s at {time} s", { count: reading.gaps, width: number(reading.widest_gap_s, 3), time: number(reading.widest_gap_at_s, 5) }) : tr("none")],
      [`${tr("speed")}, ${speedUnit()}`, range(reading.speed_rad_s, inSpeedUnit)], [tr("torque, N·m"), range(reading.torque_nm)],
    ];
    return el("dl", { class: "figures" }, ...rows.map(([name, text]) => el("div", {}, el("dt", {}, name), el("dd", {}, text))));
  }

  /** The first rows of a trace; the chosen columns are marked. */
  function table(found, chosen) {
    const of = (name) => QUANTITIES.find((quantity) => chosen[quantity] === name);
    const mark = (name) => (of(name) ? "mapped" : null);
    return el("table", {},
      el("caption", {}, tr("Header in line {line}; {encoding}, {separator} between cells, decimal {decimal}", { line: found.header_line, encoding: found.encoding, separator: word(found.separator, "sign"), decimal: word(found.decimal, "sign") })),
      el("thead", {}, el("tr", {}, ...found.names.map((name, k) => el("th", { scope: "col", class: mark(name) }, of(name) ? el("small", {}, word(of(name), "quantity")) : null, name || "–", found.units[k] ? el("span", { class: "dim" }, ` ${found.units[k]}`) : null)))),
      el("tbody", {}, ...found.rows.map((row) => el("tr", {}, ...row.map((cell, k) => el("td", { class: mark(found.names[k]) }, cell))))));
  }

  /** What a log of tdhil states of its run. */
  function ofLog(run) {
    const drive = run.drive || {}, rig = run.rig || {};
    const rows = [[tr("rig in the log"), rig.name || rig.file], [tr("date"), run.date ? when(run.date) : null], [tr("operator"), run.operator], [tr("note"), run.note], [tr("drive"), drive.name], [tr("serial number"), drive.serial || null],
      [tr("profile"), run.profile && run.profile.name], [tr("recorded by"), run.recorded_by && `tdhil ${run.recorded_by}`], [tr("stages"), run.stages.map((one) => `${word(one.name, "stage")} ${word(one.outcome, "outcome")}`).join(", ")], [tr("log"), run.complete ? tr("whole") : tr("cut short")]];
    return el("div", {}, el("p", {}, badge(run.simulated), " ", rehearsal(run.rehearsed_faults.length)),
      el("table", {}, el("tbody", {}, ...rows.filter(([, text]) => text).map(([name, text]) => el("tr", {}, el("th", { scope: "row" }, name), el("td", {}, String(text)))))));
  }

  function uploadPage() {
    if (!byId("choose")) return;
    const form = byId("mapping"), said = byId("choose-said"), file = byId("file");
    let limit = Infinity, open = null, waits = [], asking = 0, redraw = () => {}, read = null;
    const report = (error, where = said) => { where.textContent = whyOf(error); where.hidden = false; };
    const field = (name) => form.elements[name];

    /** The mapping of the form, as the service takes it. */
    function mapping() {
      const found = asked(form), columns = [];
      for (const quantity of QUANTITIES) {
        const name = field(`columns.${quantity}`).value, unit = field(`unit.${quantity}`).value;
        if (open.kind === "trace" && name) columns.push(`${quantity}=${name}${unit ? `:${unit}` : ""}`);
        delete found[`columns.${quantity}`];
        delete found[`unit.${quantity}`];
      }
      if (open.kind === "log") for (const one of byId("of-trace").querySelectorAll("[name]")) delete found[one.name];
      return columns.length ? { ...found, columns } : found;
    }
    const chosen = () => Object.fromEntries(QUANTITIES.map((one) => [one, field(`columns.${one}`).value]));

    /** Offer the columns and units of the file, with the guess chosen. */
    function offer(found) {
      for (const guess of found.guess) {
        const names = [...new Set(found.names.filter(Boolean))];
        show(field(`columns.${guess.quantity}`), el("option", { value: "" }, tr("choose …")), ...names.map((one) => el("option", { value: one, selected: one === guess.column }, one)));
        show(field(`unit.${guess.quantity}`), el("option", { value: "" }, guess.quantity === "time" ? tr("s, or clock time") : tr("as the file states, else SI")), ...found.known_units[guess.quantity].map((one) => el("option", { value: one, selected: one === guess.unit }, one)));
      }
    }

    function draw(found) {
      const { preview } = found;
      read = found;
      byId("problem").hidden = !preview.problem;
      byId("problem").textContent = preview.problem ? marked(form, errorText(preview.problem), byId("problem"), false) : "";
      if (preview.table) show(byId("table"), table(preview.table, chosen()));
      const reading = preview.reading, place = el("div");
      show(byId("reading"), preview.run ? ofLog(preview.run) : null, reading ? figures(reading) : null, reading ? place : null, reading && reading.samples ? el("p", { class: "dim said" }, byId("reading").dataset.said) : null,
        reading && reading.warnings.length ? el("details", { open: reading.warnings.length < 6 }, el("summary", {}, tr("Notes from reading the file: {count}", { count: reading.warnings.length })), el("ul", {}, ...reading.warnings.map((one) => el("li", {}, english(one))))) : null);
      redraw = reading && reading.samples ? plots(place, reading.plot) : () => {};
    }

    /** Read the upload with the present mapping. Each wrong value is marked at its field. */
    async function preview(first = false) {
      const mine = ++asking, over = first ? waiting(byId("reading"), tr("Reading the file"), "preview") : () => {};
      byId("mapping-said").hidden = true;
      try {
        const found = await call("POST", `/uploads/${open.id}/preview`, first ? {} : mapping(), {}, LONG_MS);
        over(true);
        if (mine !== asking) return;
        if (first && found.preview.table) offer(found.preview.table);
        unmark(form);
        draw(found);
        if (found.wrong.length) refused(form, byId("mapping-said"), { fields: found.wrong }, false);
      } catch (error) {
        over(false);
        if (mine !== asking) return;
        if (first) show(byId("reading"));
        refused(form, byId("mapping-said"), error, false);
      }
    }

    function present(upload) {
      open = upload;
      history.replaceState(null, "", `/upload?upload=${upload.id}`);
      byId("preview").hidden = false;
      byId("upload-name").textContent = upload.name;
      show(byId("upload-about"), `${upload.kind === "log" ? tr("Log of tdhil") : tr("Trace in CSV")}, ${mebi(upload.size_bytes)}, ${tr("uploaded by {name}", { name: upload.by })}, ${when(upload.at)}. SHA-256 `, el("code", {}, upload.sha256));
      others();
      byId("of-trace").hidden = upload.kind !== "trace";
      form.hidden = false;
      show(byId("identifying"));
      show(byId("reading"));
      byId("problem").hidden = true;
      unmark(form);
      if (BUSY.includes(upload.state)) follow(); else preview(true);
      byId("preview").scrollIntoView();
    }

    /** Wait for the run of the upload, and go to its page. */
    async function follow() {
      const over = waiting(byId("identifying"), tr("Identifying"), "upload");
      form.inert = true;
      try {
        for (;;) {
          const found = await call("GET", `/uploads/${open.id}`);
          if (found.run) {
            over(true);
            location.assign(`/runs/${found.run}`);
            return;
          }
          byId("delayed").hidden = found.state !== "delayed";
          if (found.state === "failed") throw new Refused(errorText(found.error));
          await new Promise((done) => { setTimeout(done, 400); });
        }
      } catch (error) {
        over(false);
        show(byId("identifying"));
        byId("delayed").hidden = true;
        form.inert = false;
        refused(form, byId("mapping-said"), error);
      }
    }

    async function list() {
      const found = await call("GET", "/uploads");
      limit = found.limit_bytes;
      byId("limit").textContent = tr("at most {size}", { size: mebi(limit) });
      waits = found.uploads;
      others();
      return waits;
    }
    /** The uploads that wait, without the one that is open. */
    function others() {
      const found = waits.filter((one) => !open || one.id !== open.id);
      byId("waiting").hidden = !found.length;
      show(byId("uploads"), ...found.map((one) => el("li", {}, el("button", { type: "button", class: "quiet", onclick: () => present(one) }, one.name), ` ${mebi(one.size_bytes)}, ${one.by}, ${when(one.at)}`, one.state === "waiting" ? "" : `, ${word(one.state, "state")}`)));
    }

    async function take(chosenFile) {
      said.hidden = true;
      if (!chosenFile.size) return report(new Refused(tr("This file is empty. Choose another file.")));
      if (chosenFile.size > limit) return report(new Refused(tr("This file has {size}. The limit is {limit}. Export the part with the motion.", { size: mebi(chosenFile.size), limit: mebi(limit) })));
      const bar = byId("sending").querySelector("progress");
      const sending = send(chosenFile, (loaded, total) => {
        bar.max = total;
        bar.value = loaded;
        byId("sent").textContent = tr("{part} of {whole}", { part: mebi(loaded), whole: mebi(total) });
      });
      byId("sending").hidden = false;
      file.disabled = true;
      byId("cancel").onclick = sending.cancel;
      try {
        const upload = await sending.found;
        await list();
        present(upload);
      } catch (error) {
        report(error);
      } finally {
        byId("sending").hidden = true;
        file.disabled = false;
        file.value = "";
      }
      return undefined;
    }

    file.addEventListener("change", () => { if (file.files.length) take(file.files[0]); });
    const zone = byId("choose");
    zone.addEventListener("submit", (event) => event.preventDefault());
    for (const kind of ["dragover", "dragleave", "drop"]) zone.addEventListener(kind, (event) => {
      event.preventDefault();
      zone.classList.toggle("over", kind === "dragover");
      if (kind === "drop" && event.dataTransfer.files.length && !file.disabled) take(event.dataTransfer.files[0]);
    });
    form.addEventListener("change", (event) => { if (byId("of-trace").contains(event.target)) preview(); });
    byId("again").addEventListener("click", () => preview());
    form.addEventListener("submit", (event) => {
      event.preventDefault();
      submits(form, byId("mapping-said"), async () => {
        open = await call("POST", `/uploads/${open.id}/identify`, mapping());
        follow();
      });
    });
    byId("discard").addEventListener("click", () => {
      if (!confirm(tr("Delete {name}?", { name: open.name }))) return;
      submits(form, byId("mapping-said"), async () => {
        await call("POST", `/uploads/${open.id}/delete`, {});
        location.assign("/upload");
      });
    });
    onSpeedUnit(() => { if (read) draw(read); });
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => redraw());
    call("GET", "/rigs").then((rigs) => field("rig").append(...rigs.map((one) => el("option", { value: one.id }, one.name))), () => {});
    list().then((uploads) => {
      const wanted = new URLSearchParams(location.search).get("upload"), found = uploads.find((one) => one.id === wanted);
      if (found) present(found);
    }).catch((error) => report(error));
  }

  pages.upload = uploadPage;
})();
