// Results: one run, a comparison, a rig over time, many logs. As in app.js, data from elsewhere are inserted as text.
"use strict";
(() => {
  const { byLabels, coded, english, errorText, fixed, local, point, precise, tr, word, worded } = window.tdhilLanguage;
  const { API, ENDED, LEAVES, STATES, Refused, asked, away, axis, badge, byId, call, closes, colour, el, eventText, every, follow, inSpeedUnit, inertia, inertiaNow, interval, listen, markWrong, may, nearest, number, ofResult, ofSpeed, onSpeedUnit, pacing, pages, percent, reading, rehearsal, rounded, scrolls, shareOf, show, span, speedUnit, stateText, stopSteps, submits, toolbar, unmark, unwatched, uploaded, viewOf, waiting, when, whyOf, zone } = window.tdhil;

  // -- one run

  function resultOf(run) {
    const result = run.result;
    const parts = [el("p", { class: "now" }, el("strong", { class: run.state === "stop_not_confirmed" ? "alarm" : "" }, `${stateText(run.state, run.stop, run.history)}${run.stage && !ENDED.includes(run.state) ? `: ${word(run.stage, "stage")}` : ""}`))];
    if (run.error) parts.push(el("p", { class: wanted(run) ? "dim" : "alarm" }, errorText(run.error)));
    if (run.watch && run.watch.lost) parts.push(el("p", { class: "alarm" }, unwatched(run.watch)));
    const steps = stopSteps(run.stop);
    if (steps.length && ENDED.includes(run.state)) parts.push(el("ol", { class: "stop-times", "aria-label": tr("Stop") }, ...steps));
    if (!ENDED.includes(run.state)) parts.push(el("p", {}, el("a", { class: "button", href: `/runs/${run.id}/live` }, tr("Live"))));
    parts.push(...rehearsed(run));
    if (result && result.acceptance) parts.push(el("p", { class: `verdict ${ACCEPTED[result.acceptance.verdict] || "fair"}` }, el("a", { href: "#accepted" }, tr("Acceptance")), `: ${word(result.acceptance.verdict, "verdict")}`));
    if (!result) {
      if (ENDED.includes(run.state) && run.files.includes("run.mcap")) parts.push(el("p", { class: "dim" }, tr("No J: the run ended before its data determined one. The recorded motion is kept.")));
      return parts;
    }
    const rows = [[tr("verdict"), word(result.verdict, "verdict")]];
    const J = result.inertia_kg_m2;
    const estimate = (one, unit) => (one ? `${of(one)} ${unit}` : null);
    // an estimate that is proportional to the torque is quoted with the torque scale, like J
    const quoted = (one) => (one && one.low_total !== undefined ? { ...one, low: one.low_total, high: one.high_total } : one);
    if (J) rows.push([tr("J, {share} % interval to quote", { share: number(100 * (J.confidence ?? 0.95)) }), `${ofResult(result)}  ${shareOf(J.value, J.low_total, J.high_total)}`], [tr("repeatability, this drive"), `${of(J)} kg·m²  ${shareOf(J.value, J.low, J.high)}`]);
    for (const [name, key, unit] of [[tr("viscous friction B"), "viscous_nm_s_rad", "N·m·s/rad"], [tr("Coulomb friction T_c, constant load included"), "coulomb_nm", "N·m"], [tr("lag of the reported speed"), "speed_lag_s", "s"], [tr("lag of the reported torque"), "torque_lag_s", "s"], [tr("time offset between speed and torque"), "skew_s", "s"]]) {
      const text = estimate(quoted(result[key]), unit);
      if (text) rows.push([name, text]);
    }
    if (result.model) rows.push([tr("model"), result.model]);
    for (const one of result.second_opinions || []) {
      const agrees = one.agrees === null ? "" : one.agrees ? `, ${tr("agrees")}` : `, ${tr("DISAGREES")}`;
      rows.push([tr("momentum cross-check, {route}", { route: one.route }), `${estimate(one.inertia_kg_m2, "kg·m²")}${agrees}`]);
    }
    const card = el("div", { class: "card" },
      J ? el("p", { class: "figure large" }, `J = ${ofResult(result)}`) : null,
      el("p", { class: `verdict ${wanted(run) && !J ? "" : VERDICTS[result.verdict] || ""}` }, word(result.verdict, "verdict")),
      region(tr("Numbers"), el("table", {}, el("tbody", {}, ...rows.map(([name, text]) => el("tr", {}, el("th", { scope: "row" }, name), el("td", {}, text)))))),
      el("p", {}, ...coded(result.code, sentence(result.reason || ""))), result.advice ? el("p", {}, english(sentence(result.advice))) : null,
      run.rig && may("operator") && result.calibration_advised ? el("p", {}, el("a", { href: `/calibrate/${encodeURIComponent(run.rig)}` }, tr("Calibrate the torque of this rig"))) : null);
    parts.push(card);
    const codes = result.warning_codes || [];
    (result.warnings || []).forEach((one, k) => parts.push(el("p", { class: wanted(run) && codes[k] === ENDED_EARLY ? "dim" : "alarm" }, ...coded(codes[k], sentence(one)))));
    return parts;
  }
  /** Expected against identified, each by its interval, and what is off. */
  function accepted(result) {
    const found = result && result.acceptance;
    if (!found) return [];
    const short = (value, more) => Number(value.toPrecision(5 + more));
    const judged = (expected, tolerance, low, high) => (expected - tolerance <= low && high <= expected + tolerance ? "pass" : high < expected - tolerance || expected + tolerance < low ? "fail" : "");
    /** The least digits beyond the usual with which the shown numbers give the verdict, as in the report. */
    const digits = (one) => [0, 1, 2, 3].find((more) => {
      const at = rounded(one.value, one.low, one.high, more);
      const ends = one.low === one.high ? [short(one.value, more), short(one.value, more)] : [at.low, at.high].map((end) => Number(end.toFixed(at.places)));
      return judged(short(one.expected, more), short(one.tolerance, more), ...ends) === judged(one.expected, one.tolerance, one.low, one.high);
    }) ?? 4;
    const limits = (one, more) => `${local(String(short(one.expected, more)))} ± ${local(String(short(one.tolerance, more)))} ${one.unit}`;
    const more = new Map(found.quantities.map((one) => [one, typeof one.value === "number" && one.low !== null && one.high !== null ? digits(one) : 0]));
    const wide = found.quantities.some((one) => !["pass", "fail"].includes(one.verdict) && one.value !== null);
    return [el("section", { class: "card" }, el("h2", {}, tr("Acceptance")),
      el("p", { class: `verdict ${ACCEPTED[found.verdict] || "fair"}` }, word(found.verdict, "verdict")),
      ...found.off.map((one) => el("p", { class: "alarm" }, ...coded(found.code, `${one} [${found.code}]`))),
      region(tr("Acceptance"), el("table", { class: "whole" }, el("thead", {}, el("tr", {}, ...[tr("quantity"), tr("expected"), tr("identified"), tr("verdict")].map((one) => el("th", { scope: "col" }, one)))),
        el("tbody", {}, ...found.quantities.map((one) => el("tr", {}, el("th", { scope: "row" }, word(one.label)),
          el("td", {}, typeof one.expected === "string" ? one.expected : limits(one, more.get(one))),
          el("td", {}, one.value === null ? tr("not identified") : typeof one.value === "string" ? one.value : `${interval(one.value, one.low, one.high, more.get(one))} ${one.unit}`),
          el("td", { class: `verdict ${ACCEPTED[one.verdict] || "fair"}` }, word(one.verdict, "verdict"))))))),
      wide ? el("p", {}, tr("An interval overlaps the edge of its tolerance. Calibrate the torque, or measure for longer.")) : null)];
  }
  /** The verdict on rehearsed faults: required and seen. */
  function rehearsed(run) {
    const found = run.rehearsal_verdict;
    if (!found) return [];
    const rows = [...found.faults.flatMap((one) => [
      [one.fault, tr("{verdict}; exit {codes} is required", { verdict: word(one.verdict, "verdict"), codes: one.codes.join(` ${tr("or")} `) })],
      [one.row ? tr("required by row {row}", { row: one.row }) : tr("required by any fault"), english(one.required)]]), [tr("seen"), english(found.seen)]];
    return [el("section", { class: "card" }, el("h2", {}, tr("Rehearsal")),
      el("p", { class: `verdict ${{ pass: "good", fail: "bad" }[found.verdict] || "fair"}` }, word(found.verdict, "verdict")),
      region(tr("Rehearsal"), el("table", {}, el("tbody", {}, ...rows.map(([name, text]) => el("tr", {}, el("th", { scope: "row" }, name), el("td", {}, text)))))))];
  }
  const ACCEPTED = { pass: "good", fail: "bad" };
  const ENDED_EARLY = "TDH-030";
  const VERDICTS = { valid: "good", valid_wide: "fair", not_identifiable: "bad", model_rejected: "bad" };

  /** A half-width with two digits, rounded up. */
  function halfWidth(half) {
    const at = rounded(0, -half, half);
    return half > 0 ? fixed(at.high, at.places) : number(half, 2);
  }
  /** The uncertainty budget as bars, the largest contribution first; an open one has no bar. */
  function budgetOf(result) {
    const lines = [...((result && result.budget) || [])].sort((a, b) => (b.half_width_kg_m2 ?? Infinity) - (a.half_width_kg_m2 ?? Infinity));
    if (!lines.length) return [];
    const most = Math.max(...lines.map((one) => one.half_width_kg_m2 ?? 0));
    return [el("section", {}, el("h2", {}, tr("Uncertainty budget")), region(tr("Uncertainty budget"), el("table", { class: "budget" },
      el("tbody", {}, ...lines.map((one) => el("tr", {}, el("th", { scope: "row" }, word(one.source, "budget")),
        el("td", {}, `± ${halfWidth(one.half_width_kg_m2)} kg·m²`),
        el("td", {}, el("meter", { min: 0, max: most || 1, value: one.half_width_kg_m2 ?? 0, "aria-label": tr("share of the largest: {source}", { source: word(one.source, "budget") }) })),
        el("td", { class: "dim" }, english(one.note))))))), el("p", { class: "dim said" }, byId("budget").dataset.said))];
  }
  /** The stages of the recorded motion, folded: how each ended. */
  function stagesOf(result) {
    const stages = (result && result.stages) || [];
    return stages.length ? [numbers(tr("Stages"), [tr("stage"), tr("outcome"), tr("time, s"), tr("reason")],
      stages.map((one) => [word(one.name, "stage"), word(one.outcome, "outcome"), fixed(one.duration_s, 1), english(one.detail || "")]))] : [];
  }
  /** Whether an operator stopped the run on purpose: its end is no alarm. */
  const wanted = (run) => run.state === "stopped" && Boolean(run.stop.asked) && !(run.watch && run.watch.lost);

  /** The report's pictures: the first one above the budget, the others below it with the friction curve in numbers. */
  async function pictures(id, result) {
    const found = await call("GET", `/runs/${id}/pictures`);
    const bars = ((result && result.budget) || []).length > 0;             // the page has its own bars of the budget
    const [first = [], ...others] = found.filter((one) => !bars || one.heading !== byId("budget").dataset.heading).map((one) => [
      el("h2", {}, word(one.heading)),
      el("figure", {}, region(tr("{title}, picture", { title: word(one.heading) }), el("img", { src: `${API}/runs/${id}/pictures/${one.number}`, alt: byLabels(one.caption), loading: "lazy" })), el("figcaption", {}, english(one.caption)))]);
    show(byId("picture"), ...first);
    show(byId("pictures"), ...others.flat());
    const curve = (result && result.friction_curve) || [];
    if (curve.length) byId("pictures").append(numbers(tr("Friction over speed, in numbers"), [tr("speed"), tr("torque, N·m")],
      curve.map((one) => [ofSpeed(() => `${number(inSpeedUnit(one.speed_rad_s))} ${speedUnit()}`), of(one.torque_nm)])));
  }
  const of = (one) => interval(one.value, one.low, one.high) ?? "–";
  const region = (label, table) => scrolls(el("div", { class: "scroll", tabindex: 0, role: "region", "aria-label": label }, table));
  /** Make a collapsed table. Cells are texts or elements. */
  const numbers = (label, heads, rows) => el("details", {}, el("summary", {}, label), region(label, el("table", {},
    el("thead", {}, el("tr", {}, ...heads.map((one) => el("th", { scope: "col" }, one)))),
    el("tbody", {}, ...rows.map(([first, ...rest]) => el("tr", {}, el("th", { scope: "row" }, first), ...rest.map((one) => el("td", {}, one))))))));

  function runPage() {
    const id = document.body.dataset.run;
    const kept = (run) => run.state + run.files.filter((one) => !["report.pdf", "samples.csv"].includes(one)).join();    // content on which the page depends
    let shown = "", files = null, going = false, inertias = [], outdated = (document.body.dataset.outdated || "").split(" ");
    every(1500, async () => {
      const run = await call("GET", `/runs/${id}`), goes = !ENDED.includes(run.state);
      if (goes && !going) listen(id, soFar, () => going);
      going = goes;
      if (!goes) byId("so-far").hidden = true;
      outdated = run.outdated;
      if (files !== null && files !== kept(run)) again();
      if (files === null && run.files.includes("report.html")) await pictures(id, run.result);
      files = kept(run);
      const now = JSON.stringify(run);
      if (now === shown) return;
      shown = now;
      show(byId("result"), ...resultOf(run));
      show(byId("budget"), ...budgetOf(run.result));
      show(byId("accepted"), ...accepted(run.result));
      show(byId("stages"), ...stagesOf(run.result));
      byId("replays").hidden = !ENDED.includes(run.state) || !run.files.includes("run.mcap");
      const first = run.result ? [{ asked: {}, result: run.result, state: "done", first: true }] : [];
      show(byId("replay-rows"), ...[...first, ...run.replays].map((one) => el("tr", {},
        el("th", { scope: "row" }, one.first ? tr("the run itself") : english(Object.entries(one.asked).map(([name, value]) => `${name} ${value}`).join(", ")) || tr("as the run")),
        el("td", {}, one.state === "delayed" ? delayed(one) : one.state === "waiting" ? waits(one) : one.error ? errorText(one.error) : word(one.result.verdict, "verdict")),
        el("td", {}, ofResult(one.result) || "–"),
        el("td", {}, one.result && one.result.inertia_kg_m2 ? shareOf(one.result.inertia_kg_m2.value, one.result.inertia_kg_m2.low_total, one.result.inertia_kg_m2.high_total) : ""))));
    });
    /** Show the time of the run and its latest J, while it goes on. */
    function soFar(found) {
      if (found.type === "hello") inertias = [];
      inertias.push(...(found.inertias || []));
      byId("time-now").textContent = found.time_s === null ? "–" : span(found.time_s);
      byId("so-far").hidden = found.time_s === null;
      if (inertias.length) inertiaNow(inertias);
    }
    let typed = false;
    byId("main").addEventListener("input", () => { typed = true; });
    /** Show the new content of this page: at once, or on request if the page has a text that is not saved. */
    function again() {
      if (!typed) return location.reload();
      show(byId("newer"), `${tr("This page has new content. Save your text first, then show it.")} `, el("button", { type: "button", class: "quiet", onclick: () => location.reload() }, tr("Show it")));
      byId("newer").hidden = false;
      return undefined;
    }
    const clocks = new Map(), held = new Set();
    /** The reason why a replay has not begun. */
    function delayed(one) {
      held.add(one.name);
      return tr("waits until {holder} has ended", { holder: one.holder });
    }
    /** The cell of a replay that goes on: since when, and its usual time. It stays the same element. */
    function waits(one) {
      if (!clocks.has(one.name)) {
        const cell = el("div");
        waiting(cell, tr("Identifying again"), "replay", held.has(one.name) ? Date.now() : Date.parse(one.at));
        clocks.set(one.name, cell);
      }
      return clocks.get(one.name);
    }
    for (const link of document.querySelectorAll(".files a[href$='report.pdf'], .files a[href$='report.html'], .files a[href$='samples.csv']")) report(link);
    /** A report that is made first, or made again after a signature, an edit or a new letterhead: the page shows this. */
    function report(link) {
      const name = link.href.slice(link.href.lastIndexOf("/") + 1), inPage = name === "report.html", samples = name === "samples.csv";
      const note = el("div", { class: "making" });
      let busy = false;
      link.addEventListener("click", async (event) => {
        const again = outdated.includes(name);
        if (!again && (inPage || link.dataset.ready !== undefined)) return;
        event.preventDefault();
        if (busy) return;
        busy = true;
        link.closest("li").append(note);
        const over = waiting(note, samples ? tr("Making the file") : inPage ? tr("Making the page again") : again ? tr("Making the PDF again") : tr("Making the PDF"), samples ? "samples" : inPage ? "page" : "pdf");
        try {
          const answer = await fetch(link.href);
          if (!answer.ok) throw new Refused(errorText((await answer.json()).error));
          if (samples) answer.body.cancel();             // the browser downloads it
          over(true);
          link.dataset.ready = "";
          outdated = outdated.filter((one) => one !== name);
          if (inPage) show(note, el("p", { role: "status" }, tr("The page was made again:"), " ", el("a", { href: link.href, target: "_blank", rel: "noopener" }, tr("open it"))));
          else { show(note); link.click(); }
        } catch (error) {
          over(false);
          show(note, el("p", { class: "alarm", role: "alert" }, whyOf(error)));
        } finally {
          busy = false;
        }
      });
    }
    const replay = byId("replay");
    if (replay) replay.addEventListener("submit", (event) => {
      event.preventDefault();
      const said = byId("replay-said");
      said.className = "alarm";
      submits(replay, said, async () => {
        const found = await call("POST", `/runs/${id}/replays`, asked(replay));
        if (found.state === "done") { said.textContent = tr("Replay {number} below has these settings.", { number: Number(found.name) }); said.className = "dim"; said.hidden = false; }
      });
    });
    events(id);
    annotations(id);
    signature(id);
    evidence(id);
    const sign = byId("sign");
    if (sign) sign.addEventListener("submit", (event) => {
      event.preventDefault();
      submits(sign, byId("sign-said"), async () => {
        await call("POST", `/runs/${id}/sign-off`, { note: sign.elements.note.value });
        location.reload();
        return LEAVES;
      });
    });
  }

  /** The events of the log, the latest first, once their part is opened: the log has them, not the result. */
  function events(id) {
    const box = byId("log-events"), list = box && box.querySelector("ol");
    let socket = null;
    if (box) box.addEventListener("toggle", () => {
      if (!box.open || socket) return;
      socket = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}${API}/live/${id}`);
      socket.addEventListener("message", (event) => {
        const found = JSON.parse(event.data);
        if (found.type === "hello") list.replaceChildren();
        for (const one of found.events || []) list.prepend(el("li", {}, ...eventText(one)));
      });
    });
  }

  /** Tags as badges. */
  const tags = (found) => found.map((one) => el("span", { class: "tag" }, one));

  /** The signature under an acceptance: whether it still holds; or the form, once the hash of the log is known. */
  async function signature(id) {
    const where = byId("acceptance"), form = byId("accept"), problem = byId("signature-problem");
    if (!where || (!form && !problem)) return;
    const said = form ? byId("accept-said") : problem, fail = (text) => { said.textContent = text; said.hidden = false; };
    let found = null;
    if (form) form.addEventListener("submit", (event) => {
      event.preventDefault();
      submits(form, said, async () => {
        await call("POST", `/runs/${id}/acceptance`, { name: form.elements.name.value, remark: form.elements.remark.value, verdict: where.dataset.verdict, log_sha256: found.log_sha256 });
        location.reload();
        return LEAVES;
      });
    });
    try {
      found = await call("GET", `/runs/${id}/acceptance`, undefined, {}, 120000);
      if (found.problem) fail(`${tr("The signature is not valid:")} ${found.problem}.`);
      if (!form) return;
      byId("log-sha256").textContent = found.log_sha256;
      form.querySelector("button").disabled = false;
    } catch (error) {
      fail(whyOf(error));
    }
  }

  /** The archive of evidence: its form marks every wrong field; the page comes again with the link. */
  function evidence(id) {
    const form = byId("evidence-form"), wait = byId("evidence-wait");
    if (!form) return;
    form.addEventListener("submit", (event) => {
      event.preventDefault();
      submits(form, byId("evidence-said"), async () => {
        const over = waiting(wait, tr("Making the archive"), "evidence");
        try {
          await call("POST", `/runs/${id}/evidence`, asked(form), {}, 600000);
          over(true);
          location.reload();
        } finally {
          over(false);
          show(wait);
        }
      });
    });
  }

  /** Forms that change the records of a run: annotations, archive, deletion. Each is there for its role only. */
  function annotations(id) {
    const form = byId("annotate"), archive = byId("archive"), remove = byId("delete");
    if (form) form.addEventListener("submit", (event) => {
      event.preventDefault();
      submits(form, byId("annotate-said"), async () => {
        const texts = Object.fromEntries([...form.elements].filter((one) => one.name).map((one) => [one.name, one.value]));
        await call("POST", `/runs/${id}/annotations`, { ...texts, tags: texts.tags.split(",") });
        location.reload();
        return LEAVES;
      });
    });
    if (archive) archive.addEventListener("submit", (event) => {
      event.preventDefault();
      submits(archive, byId("archive-said"), async () => {
        await call("POST", `/runs/${id}/archive`, { archived: archive.dataset.archived !== "yes" });
        location.reload();
        return LEAVES;
      });
    });
    if (!remove) return;
    const typed = remove.elements.confirm, button = remove.querySelector("button");
    const ready = () => { button.disabled = typed.value.trim() !== id; };
    typed.addEventListener("input", ready);
    ready();
    remove.addEventListener("submit", (event) => {
      event.preventDefault();
      submits(remove, byId("delete-said"), async () => {
        await call("POST", `/runs/${id}/delete`, { confirm: typed.value });
        location.replace("/runs");
        return LEAVES;
      });
    });
  }

  // -- lists

  const NO_RIG = tr("Uploaded recording");         // as the title of its page
  const TURNED = ["sort", "order", "page", "until"];        // what an address of the list has beside its fields
  function runsPage() {
    const chosen = new Map(), link = byId("compare"), none = byId("none"), form = byId("search"), turn = byId("turn");
    const heads = [...document.querySelectorAll("[data-key]")], named = [...form.elements].filter((one) => one.name);
    let query = new URLSearchParams(), found = null, shown = "", asking = 0;
    link.addEventListener("click", () => location.assign(`/compare?runs=${[...chosen.keys()].sort().join()}${form.elements.archived.checked ? "&archived=true" : ""}${[...chosen.values()].some(Boolean) ? "&rehearsals=true" : ""}`));
    function said() {
      const enough = chosen.size >= 2 && chosen.size <= 8;
      link.disabled = !enough;
      none.hidden = !chosen.size;
      byId("chosen").textContent = chosen.size ? chosen.size > 8 ? tr("{count} chosen, eight at most", { count: chosen.size }) : tr("{count} chosen", { count: chosen.size }) : tr("Choose two to eight runs.");
    }
    none.addEventListener("click", () => { chosen.clear(); said(); draw(); });
    form.elements.state.append(...Object.entries(STATES).map(([state, text]) => el("option", { value: state }, text)));

    const names = JSON.parse(document.body.dataset.rigs), nameOf = (rig) => names[rig] || rig;      // a removed rig has its id only
    /** Fill a choice with the values that occur. The chosen one stays, also if it occurs no more. */
    function offer(select, values, text = (one) => one) {
      const now = query.get(select.name) || "", all = [...new Set([...values, ...(now ? [now] : [])])];
      if (JSON.stringify(all) !== select.dataset.offered) show(select, select.options[0], ...all.map((one) => el("option", { value: one }, text(one))));
      select.dataset.offered = JSON.stringify(all);
      select.value = now;
    }
    const choices = ({ rigs = [], verdicts = [], acceptances = [], tags: occurring = [] }) => {
      offer(form.elements.rig, rigs, nameOf);
      for (const [select, values] of [[form.elements.verdict, verdicts], [form.elements.acceptance, acceptances]]) offer(select, values, (one) => word(one, "verdict"));
      offer(form.elements.tag, occurring);
    };
    /** Show the list of an address: its fields, its order, its page. */
    function fromAddress() {
      query = new URLSearchParams(location.search);
      for (const one of named) if (one.type === "checkbox") one.checked = query.get(one.name) === "true"; else if (one.name === "text" || one.name === "state") one.value = query.get(one.name) || "";
      choices(found || {});
    }
    /** The address of this list with other values; without a value for null. */
    function addressOf(changes) {
      const next = new URLSearchParams(query);
      for (const [name, value] of Object.entries(changes)) if (value) next.set(name, value); else next.delete(name);
      return `${location.pathname}${next.size ? `?${next}` : ""}`;
    }
    function present(address, push) {
      history[push ? "pushState" : "replaceState"](null, "", address);
      query = new URLSearchParams(location.search);
      again();
    }
    function draw() {
      const people = (one) => [one.operator, one.note].filter(Boolean).join(": ");
      const filtered = [...query.keys()].some((one) => !TURNED.includes(one) && one !== "archived");
      show(byId("runs"), ...(found.runs.length ? found.runs.map((one) => {
        const at = when(one.asked), rig = one.rig ? nameOf(one.rig) : NO_RIG, name = `${rig}, ${at}`;
        const box = el("input", { type: "checkbox", "aria-label": tr("compare {run}", { run: name }), disabled: one.verdict === null });
        box.checked = chosen.has(one.id);
        box.addEventListener("change", () => { if (box.checked) chosen.set(one.id, one.rehearsal); else chosen.delete(one.id); said(); });
        return el("tr", {}, el("td", { class: "pick" }, box),
          el("th", { scope: "row" }, el("a", { href: `/runs/${one.id}`, "aria-label": name }, rig), " ", badge(one.simulated) || "", " ", rehearsal(one.rehearsal) || "", " ", uploaded(one.uploaded) || ""),
          el("td", {}, at), el("td", {}, STATES[one.state] || one.state), el("td", { class: "answer" }, inertia(one) || "–"), el("td", { class: `verdict ${VERDICTS[one.verdict] || ""}` }, one.verdict ? word(one.verdict, "verdict") : ""),
          el("td", { class: `acceptance verdict ${one.acceptance ? ACCEPTED[one.acceptance] || "fair" : ""}`, "data-label": heads.find((head) => head.dataset.key === "acceptance").textContent }, one.acceptance ? word(one.acceptance, "verdict") : null),
          el("td", {}, people(one), ...(one.tags.length ? [" ", ...tags(one.tags)] : []), ...(one.archived ? [" ", el("span", { class: "badge" }, tr("ARCHIVED"))] : [])));
      }) : [el("tr", {}, el("td", { colspan: 8, class: "dim" }, found.total ? tr("no run on this page") : filtered ? tr("no run matches") : tr("no run yet")))]));
      const last = found.first + found.runs.length - 1;
      byId("position").textContent = found.runs.length ? found.total === 1 ? tr("1 run") : tr("Runs {first} to {last} of {total}", { first: found.first, last, total: found.total }) : "";
      turn.hidden = found.pages === 1 && found.page === 1;
      turn.querySelector("span").textContent = tr("Page {page} of {pages}", { page: found.page, pages: found.pages });
      for (const [rel, page] of [["prev", Math.min(found.page - 1, found.pages)], ["next", found.page + 1]]) {
        const one = turn.querySelector(`[rel=${rel}]`), there = page >= 1 && page <= found.pages;
        if (there) one.href = addressOf(page === 1 ? { page: null, until: null } : { page, until: found.until }); else one.removeAttribute("href");
        one.setAttribute("aria-disabled", String(!there));
      }
      const key = query.get("sort") || "id", way = (query.get("order") || "desc") === "desc" ? "descending" : "ascending";
      for (const one of heads) if (one.dataset.key === key) one.parentElement.setAttribute("aria-sort", way); else one.parentElement.removeAttribute("aria-sort");
    }
    async function look() {
      const mine = ++asking, next = await call("GET", `/runs/page?${query}`), now = JSON.stringify(next) + query;
      if (mine !== asking || now === shown) return;          // a later request is on its way; or keep the keyboard focus
      shown = now;
      found = next;
      choices(found);
      draw();
    }
    const again = () => look().catch((error) => { if (error instanceof Refused) away(error.message); });
    form.addEventListener("input", () => present(addressOf({ ...Object.fromEntries(named.map((one) => [one.name, one.type === "checkbox" ? one.checked && "true" : one.value.trim()])), page: null, until: null }), false));
    form.addEventListener("submit", (event) => { event.preventDefault(); again(); });
    for (const one of heads) one.addEventListener("click", () => {
      const { key } = one.dataset, down = key === (query.get("sort") || "id") ? query.get("order") === "asc" : key === "id";
      present(addressOf({ sort: key === "id" ? null : key, order: key === "id" && down ? null : down ? "desc" : "asc", page: null, until: null }), false);
    });
    turn.addEventListener("click", (event) => {
      const to = event.target.closest("a[href]");
      if (!to || event.ctrlKey || event.metaKey || event.shiftKey) return;
      event.preventDefault();
      present(to.href, true);                        // the choice of runs to compare stays
      scrollTo(0, 0);
    });
    addEventListener("popstate", () => { fromAddress(); again(); });
    fromAddress();
    every(3000, look);
  }

  // -- pictures of several runs

  const ALIVE_MS = 3000;
  const alive = () => every(ALIVE_MS, () => call("GET", "/healthz"));     // a page with a single request also reports a lost service

  /** Labels of a time axis, by the distance of its marks in s: see uPlot's `axis.values`. */
  const TIMES = [
    [365 * 86400, "{YYYY}", null, null, null, null, null, null, 1],
    [28 * 86400, "{YYYY}-{MM}", null, null, null, null, null, null, 1],
    [86400, "{MM}-{DD}", "\n{YYYY}", null, null, null, null, null, 1],
    [60, "{HH}:{mm}", "\n{YYYY}-{MM}-{DD}", null, "\n{MM}-{DD}", null, null, null, 1],
    [1, ":{ss}", "\n{YYYY}-{MM}-{DD} {HH}:{mm}", null, "\n{MM}-{DD} {HH}:{mm}", null, "\n{HH}:{mm}", null, 1],
  ];

  /**
   * Points with their intervals; series: [{colour, points: [{x, value, low, high}]}]. Drawn again for another width or
   * colour scheme. `nameOf` names a point, `unit` is that of its value, `title` is that of the chart. `speed`: x is a
   * speed in rad/s.
   */
  function points(where, series, { title, label, nameOf, unit, time = false, speed = false, marks = [] }) {
    const all = series.flatMap((one) => one.points), shown = speed ? inSpeedUnit : (x) => x;
    const places = [...new Set(all.map((one) => one.x))].sort((a, b) => a - b);
    let xs = places.map(shown);
    const read = reading(where, (cursor) => {
      const x = places[nearest(xs, cursor)], valueOf = (one) => `${of(one)} ${unit}`;
      const here = series.flatMap((one, k) => one.points.filter((point) => point.x === x).map((point) => [k, point]));
      return `${nameOf(here[0][1])}: ${here.map(([k, point]) => (series.length > 1 ? tr("run {number}: {value}", { number: k + 1, value: valueOf(point) }) : valueOf(point))).join("; ")}`;
    });
    const side = () => Math.max(0.06 * (xs[xs.length - 1] - xs[0]), time ? 60 : 1e-3);
    const inside = (point, [from, to]) => shown(point.x) >= from && shown(point.x) <= to;
    const chart = { where, plot: null, title: () => title }, view = viewOf([chart], {
      tools: toolbar(where, title), least: time ? 60 : 1e-3, whole: () => [xs[0] - side(), xs[xs.length - 1] + side()],
      file: () => title.replace(/[^\p{L}\p{N}]+/gu, "-").toLowerCase(),
      table: (range) => [`run,${time ? "date" : speed ? "speed_rad_s" : "frequency_hz"},value,low,high,unit`, ...series.flatMap((one, k) => one.points.filter((point) => inside(point, range))
        .map((point) => [k + 1, time ? new Date(1000 * point.x).toISOString() : point.x, point.value, point.low ?? "", point.high ?? "", unit].join()))],
    });
    /** Range of the values in view; of all if none is in view. */
    const heights = () => {
      const seen = all.filter((point) => inside(point, view.range())), some = seen.length ? seen : all;
      const low = Math.min(...some.map((one) => one.low ?? one.value)), high = Math.max(...some.map((one) => one.high ?? one.value));
      const pad = 0.1 * (high - low) || 0.05 * Math.abs(high) || 1;
      return [low - pad, high + pad];
    };
    const draw = () => {
      if (chart.plot) chart.plot.destroy();
      xs = places.map(shown);
      chart.plot = new uPlot({
        width: where.clientWidth || 320, height: 240, legend: { show: false }, cursor: { ...read.cursor, ...view.cursor },
        scales: { x: { time, range: () => view.range() }, y: { range: heights } },
        axes: [axis({ size: 48, label: time ? tr("local time, {zone}", { zone: zone(new Date(1000 * xs[xs.length - 1])) }) : label(), labelSize: 22, ...(time ? { values: TIMES } : {}) }), axis({ size: 62 })],
        series: [{}, ...series.map(() => ({ stroke: "transparent", paths: () => null, points: { show: false } }))],
        hooks: { setCursor: read.setCursor, setSelect: view.setSelect, draw: [(self) => {
          const c = self.ctx, px = devicePixelRatio;
          c.save();
          c.beginPath(); c.rect(self.bbox.left, self.bbox.top, self.bbox.width, self.bbox.height); c.clip();
          c.lineWidth = 2 * px;
          c.strokeStyle = colour("--limit");
          c.setLineDash([6 * px, 4 * px]);
          for (const mark of marks) {
            const x = self.valToPos(mark, "x", true);
            c.beginPath(); c.moveTo(x, self.bbox.top); c.lineTo(x, self.bbox.top + self.bbox.height); c.stroke();
          }
          c.setLineDash([]);
          series.forEach((one, k) => {
            c.strokeStyle = c.fillStyle = colour(one.colour);
            const shift = (k - (series.length - 1) / 2) * 5 * px;         // points at one place are drawn side by side
            for (const point of one.points) {
              const x = self.valToPos(shown(point.x), "x", true) + shift;
              if (point.low !== null && point.high !== null) {
                c.beginPath(); c.moveTo(x, self.valToPos(point.low, "y", true)); c.lineTo(x, self.valToPos(point.high, "y", true)); c.stroke();
              }
              c.beginPath(); c.arc(x, self.valToPos(point.value, "y", true), 3.5 * px, 0, 7); c.fill();
            }
          });
          c.restore();
        }] },
      }, [xs, ...series.map(() => xs.map(() => null))], where);
      view.again();
    };
    draw();
    new ResizeObserver(() => chart.plot.setSize({ width: where.clientWidth || 320, height: 240 })).observe(where);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);
    if (speed) onSpeedUnit(() => { xs = places.map(shown); view.look(null); draw(); });
  }

  async function once(where, look, text = tr("Loading"), kind = "faults") {
    const over = waiting(where, text, kind);
    try {
      await look();
      over(true);
    } catch (error) {
      over(false);
      show(where, el("p", { class: "alarm", role: "alert" }, whyOf(error)));
    }
    alive();
  }

  const LEFT_OUT = { archived: tr("Without archived runs"), rehearsals: tr("Without rehearsals") };
  /** The part of an address that asks for archived runs or rehearsals, too, as this page's own address does. */
  function askedToo(before = "?") {
    const here = new URLSearchParams(location.search), found = Object.keys(LEFT_OUT).filter((one) => here.get(one) === "true");
    return found.length ? `${before}${found.map((one) => `${one}=true`).join("&")}` : "";
  }

  // -- a rig over time

  function historyPage() {
    const rig = document.body.dataset.rig, where = byId("history"), at = (date) => new Date(date).getTime() / 1000;
    for (const [name, without] of Object.entries(LEFT_OUT)) {
      const query = new URLSearchParams(location.search), link = byId(name);
      if (query.get(name) === "true") { query.delete(name); link.textContent = without; } else query.set(name, "true");
      link.href = `${location.pathname}${query.size ? `?${query}` : ""}`;
    }
    once(where, async () => {
      const { trend } = await call("GET", `/rigs/${encodeURIComponent(rig)}/trend${askedToo()}`, undefined, {}, 120000);
      show(where, ...trend.notes.map((one) => el("p", { class: "dim" }, english(one))));
      for (const quantity of trend.quantities.filter((one) => one.points.length)) {
        const plot = el("div", { class: "plot", role: "img", "aria-label": tr("{quantity} over time", { quantity: word(quantity.name) }) });
        where.append(el("section", {}, el("h2", {}, `${word(quantity.name)}, ${quantity.unit}`),
          el("p", { class: quantity.changes.length || quantity.drift ? "alarm" : "" }, english(quantity.text)),
          ...quantity.changes.map((one) => el("p", {}, el("a", { href: `/compare?runs=${encodeURIComponent(one.before)},${encodeURIComponent(one.after)}${askedToo("&")}` }, tr("Compare the runs before and after, {first} and {second}", { first: when(one.before_date), second: when(one.after_date) })))),
          el("figure", {}, el("figcaption", {}, tr("each point with its repeatability on this drive; dashed: a change")), plot, el("p", { class: "dim said" }, where.dataset.said)),
          numbers(tr("{quantity} in numbers", { quantity: word(quantity.name) }), [tr("run"), tr("{unit}, interval", { unit: quantity.unit })], quantity.points.map((one) => [el("span", {}, el("a", { href: `/runs/${encodeURIComponent(one.log)}` }, when(one.date)), " ", rehearsal(one.rehearsed_faults) || ""), of(one)]))));
        points(plot, [{ colour: "--c0", points: quantity.points.map((one) => ({ ...one, x: at(one.date) })) }],
          { title: `${word(quantity.name)}, ${quantity.unit}`, time: true, nameOf: (point) => when(point.date), unit: quantity.unit, marks: quantity.changes.map((one) => (at(one.before_date) + at(one.after_date)) / 2) });
      }
    }, tr("Comparing the results"), "history");
  }

  // -- comparison

  function comparePage() {
    const where = byId("compared"), runs = new URLSearchParams(location.search).get("runs") || "";
    once(where, async () => {
      const { runs: ids, comparison } = await call("GET", `/runs/compare?runs=${encodeURIComponent(runs)}${askedToo("&")}`, undefined, {}, 300000);
      const names = comparison.results.map((one, k) => `${one.rig || "?"}, ${when(one.date) || ids[k]}`);
      const dot = (k) => el("span", { class: `dot c${k}`, "aria-hidden": "true" });
      const heads = ids.map((id, k) => el("th", { scope: "col" }, dot(k), " ", el("a", { href: `/runs/${id}` }, names[k]), " ", badge(comparison.results[k].simulated) || "", " ", rehearsal(comparison.results[k].rehearsed_faults) || "", " ", uploaded(comparison.results[k].uploaded) || ""));
      const said = comparison.differences.map((one, k) => {
        const moment = one.quantities.find((other) => other.column === "inertia_kg_m2");
        return el("p", { class: moment && moment.differs ? "now alarm" : "now" }, dot(0), " ", names[0], ` ${tr("and")} `, dot(k + 1), ` ${names[k + 1]}: `, english(`${one.text}.`));
      });
      const others = comparison.differences.flatMap((one, k) => one.quantities.filter((other) => other.column !== "inertia_kg_m2").map((other) => [
        tr("{quantity}, {run} against 1", { quantity: word(other.name), run: k + 2 }), other.differs ? tr("differs") : tr("no significant difference"),
        other.relative ? tr("{value} ({low} to {high})", { value: percentOf(other.change), low: percentOf(other.low), high: percentOf(other.high) }) : `${tr("{value} ({low} to {high})", { value: number(other.change, 3), low: number(other.low, 3), high: number(other.high, 3) })} ${other.unit}`]));
      const curve = (title, label, key, x, said, unit, nameOf, speed = false) => {
        const series = comparison[key].map((found, k) => ({ colour: `--c${k}`, points: found.filter((one) => one.value !== null).map((one) => ({ ...one, x: one[x] })) }));
        if (!series.some((one) => one.points.length)) return [];
        const plot = el("div", { class: "plot", role: "img", "aria-label": title });
        setTimeout(() => points(plot, series, { title, label, nameOf, unit, speed }), 0);             // after it has a width
        return [el("h2", {}, title), el("p", { class: "row legend" }, ...names.map((name, k) => el("span", {}, dot(k), ` ${k + 1}: ${name}`))), el("figure", {}, plot, el("p", { class: "dim said" }, said)),
          numbers(tr("{title}, in numbers", { title }), [speed ? ofSpeed(label) : label(), ...names], tabled(series, speed ? (x) => ofSpeed(() => number(inSpeedUnit(x))) : number))];
      };
      show(where, ...said,
        region(tr("Results"), el("table", {}, el("thead", {}, el("tr", {}, el("td", {}), ...heads)), el("tbody", {},
          line(tr("J, interval to quote, kg·m²"), comparison.results.map((one) => interval(one.inertia_kg_m2, one.inertia_low_total_kg_m2, one.inertia_high_total_kg_m2) ?? "–")),
          line(tr("J, repeatability, kg·m²"), comparison.results.map((one) => interval(one.inertia_kg_m2, one.inertia_low_kg_m2, one.inertia_high_kg_m2) ?? "–")),
          line(tr("verdict"), comparison.results.map((one) => word(one.verdict, "verdict")))))),
        others.length ? numbers(tr("Friction and lags"), [tr("quantity"), "", tr("difference")], others) : null,
        ...curve(tr("Apparent inertia by frequency, kg·m²"), () => tr("frequency, Hz"), "apparent_inertia", "hertz", where.dataset.said, "kg·m²", (one) => `${number(one.x)} Hz`),
        ...curve(tr("Friction, N·m"), () => tr("speed, {unit}", { unit: speedUnit() }), "friction", "speed_rad_s", where.dataset.frictionSaid, "N·m", (one) => `${number(inSpeedUnit(one.x))} ${speedUnit()}`, true),
        el("h2", {}, tr("Settings")), el("p", { class: "dim" }, tr("≠ marks different settings.")),
        region(tr("Settings"), el("table", {}, el("thead", {}, el("tr", {}, el("td", {}), ...ids.map((id, k) => el("th", { scope: "col" }, dot(k), ` ${k + 1}`)))),
          el("tbody", {}, ...comparison.settings.map((one) => line(el("span", {}, one.differs ? "≠ " : "", english(one.name)), one.name === "date" ? one.values.map(when) : one.values.map((value) => ({ True: tr("yes"), False: tr("no") }[value] ?? english(value))), one.differs))))));
    }, tr("Identifying each run again"), "compare");
  }
  const percentOf = (share) => `${share > 0 ? "+" : ""}${precise(100 * share, 2)} %`;
  const line = (name, values, marked = false) => el("tr", marked ? { class: "differs" } : {}, el("th", { scope: "row" }, name), ...values.map((one) => el("td", {}, one)));
  /** A row for each place, a cell for each series; the mean of several points at one place. */
  function tabled(series, nameOf = number) {
    const xs = [...new Set(series.flatMap((one) => one.points.map((point) => Number(point.x.toPrecision(6)))))].sort((a, b) => a - b);
    return xs.map((x) => [nameOf(x), ...series.map((one) => {
      const here = one.points.filter((point) => Number(point.x.toPrecision(6)) === x).map((point) => point.value);
      return here.length ? number(here.reduce((sum, value) => sum + value, 0) / here.length) : "–";
    })]);
  }

  // -- rehearsals

  function rehearsePage() {
    const rig = document.body.dataset.rig, form = byId("rehearse");
    if (!form) return;
    form.addEventListener("submit", (event) => event.preventDefault());
    const paced = pacing(rig, form);
    const seconds = (name) => point(form.elements[name].value).replace(/\s*s$/, "");
    async function begin(fault, value, button) {
      const moment = fault.from_start ? "" : `@${form.elements.stage.value}${seconds("after") ? `+${seconds("after")}s` : ""}`;
      const text = `${fault.name}${moment}${value ? `=${value}` : ""}${!fault.from_start && seconds("duration") ? `/${seconds("duration")}s` : ""}`;
      unmark(form);
      const wrong = ["after", "duration"].filter((name) => !/^\d*\.?\d*$/.test(seconds(name)));
      if (wrong.length) { markWrong(form, wrong.map((option) => ({ option, said: tr("Give a number of seconds, such as 2.5.") }))); return; }
      button.disabled = true;
      if (!await paced()) { button.disabled = false; return; }
      try {
        const run = await call("POST", `/rigs/${encodeURIComponent(rig)}/runs`, { fault: [text], note: `rehearsal: ${text}`, real_time: form.elements.real_time.checked }, { "Idempotency-Key": crypto.randomUUID() });
        follow(run.id);
      } catch (error) {
        const [wrong] = error.fields || [];
        refuse(wrong ? worded(wrong.message) : whyOf(error), button);
        button.disabled = false;
      }
    }
    /** Show a refusal at the fault that was chosen: its value is marked. */
    function refuse(why, button) {
      const row = button.closest("li"), field = row.querySelector("input"), note = el("span", { class: "alarm wrong", role: "alert", id: "wrong-fault" }, why);
      row.append(note);
      if (field) {
        field.setAttribute("aria-invalid", "true");
        field.setAttribute("aria-describedby", note.id);
        field.focus();
      } else note.scrollIntoView({ block: "center" });
    }
    once(byId("said"), async () => {
      const faults = await call("GET", `/rigs/${encodeURIComponent(rig)}/faults`);
      show(byId("said"));
      show(byId("faults"), ...faults.map((one) => {
        const value = one.takes ? el("input", { value: one.value, "aria-label": `${one.name}: ${one.takes.toLowerCase()}`, lang: "en", autocomplete: "off" }) : null;
        const button = el("button", { type: "button", class: "quiet", "aria-label": tr("Rehearse {fault}", { fault: one.name }) }, tr("Rehearse"));
        button.addEventListener("click", () => begin(one, value && value.value.trim() !== one.value ? value.value.trim() : "", button));
        return el("li", {}, el("strong", { lang: "en" }, one.name, one.row ? el("span", { class: "dim" }, ` ${one.row}`) : ""),
          el("span", {}, english(one.summary), one.from_start ? el("span", { class: "dim" }, `; ${tr("from the start")}`) : "", el("br"), el("span", { class: "dim" }, `${tr("Required:")} `, english(one.required))), value || el("span"), button);
      }));
    });
  }

  // -- torque calibration

  function calibratePage() {
    const rig = document.body.dataset.rig, form = byId("calibrate"), runs = new Map();
    if (!form) return;
    const choices = [form.elements.without, form.elements.with_body], said = byId("calibrate-said");
    const named = (run) => `${when(run.asked)}, ${word(run.verdict, "verdict")}: ${tr("J as reported {inertia}", { inertia: inertia(run) })}`;
    let shown = "";
    every(2000, async () => {
      const found = (await call("GET", `/runs?rig=${encodeURIComponent(rig)}&state=done`)).filter((run) => run.inertia_kg_m2 !== null && !run.rehearsal), now = JSON.stringify(found);
      if (now === shown) return;
      shown = now;
      for (const run of found) runs.set(run.id, run);
      for (const choice of choices) {
        const kept = choice.value;
        show(choice, el("option", { value: "" }, found.length ? tr("choose a run") : tr("no run with a result yet")), ...found.map((run) => el("option", { value: run.id }, named(run))));
        choice.value = runs.has(kept) ? kept : "";
      }
    });
    const decimal = (name) => {
      const text = point(form.elements[name].value);
      return text === "" ? null : Number(text);
    };
    /** Return what can't be used, each field with its reason. */
    function mistakes(added, sd) {
      const wrong = choices.filter((one) => !one.value).map((one) => ({ option: one.name, said: tr("Choose a run.") }));
      if (!wrong.length && choices[0].value === choices[1].value) wrong.push({ option: "with_body", said: tr("Choose two different runs.") });
      if (!(added > 0)) wrong.push({ option: "added_kg_m2", said: tr("Give the inertia of the body as a positive number of kg·m².") });
      if (sd !== null && !(sd >= 0)) wrong.push({ option: "added_sd_kg_m2", said: tr("Give the standard uncertainty as a number of kg·m².") });
      return wrong;
    }
    form.addEventListener("submit", (event) => {
      event.preventDefault();
      const added = decimal("added_kg_m2"), sd = decimal("added_sd_kg_m2"), wrong = mistakes(added, sd);
      show(byId("said"));
      submits(form, said, async () => {
        if (markWrong(form, wrong)) return;
        const over = waiting(byId("said"), tr("Identifying both logs"), "calibrate"), opens = closes(form.querySelectorAll("button"));
        try {
          const body = { without: choices[0].value, with_body: choices[1].value, added_kg_m2: added, added_sd_kg_m2: sd, at: form.elements.at.value };
          const { calibration } = await call("POST", `/rigs/${encodeURIComponent(rig)}/calibration`, body, {}, 300000);
          over(true);
          show(byId("said"), ...calibrated(calibration));
          byId("said").scrollIntoView({ block: "nearest" });
        } catch (error) {
          over(false);
          show(byId("said"));
          throw error;
        } finally {
          opens();
        }
      });
    });
  }

  const sentence = (text) => text && `${text.charAt(0).toUpperCase()}${text.slice(1)}${/[.!?]$/.test(text) ? "" : "."}`;

  function calibrated(found) {
    const factor = found.calibration_factor, J = found.inertia_kg_m2, share = (one) => percent(0.5 * (one.high - one.low) / one.value);
    const rows = [[tr("verdict"), word(found.verdict, "verdict")]];
    if (factor) rows.push([tr("calibration factor"), `${of(factor)}  ${share(factor)}`], [tr("J without the body"), `${of(J)} kg·m²  ${share(J)}`]);
    for (const one of found.runs) if (one.reported_kg_m2 !== undefined) rows.push([tr("{inertia} kg·m² added", { inertia: number(one.added_kg_m2) }), tr("{inertia} kg·m² as reported", { inertia: number(one.reported_kg_m2) })]);
    const parts = [el("div", { class: "card" }, el("p", { class: "figure" }, factor ? `κ = ${of(factor)}` : word(found.verdict, "verdict")),
      region(tr("Numbers"), el("table", {}, el("tbody", {}, ...rows.map(([name, text]) => line(name, [text]))))),
      el("p", {}, english(sentence(found.reason))), found.advice ? el("p", {}, english(sentence(found.advice))) : null)];
    for (const one of found.warnings) parts.push(el("p", { class: "caution" }, english(sentence(one))));
    if (!factor) return parts;
    parts.push(el("h3", {}, tr("Uncertainty budget")), region(tr("Uncertainty budget"), el("table", {},
      el("thead", {}, el("tr", {}, ...["", tr("± % of κ"), tr("± % of J")].map((one) => el("th", { scope: "col" }, one)))),
      el("tbody", {}, ...found.budget.map((one) => line(word(one.source, "budget"), [fixed(100 * factor.coverage_factor * one.of_factor, 2), fixed(100 * J.coverage_factor * one.of_inertia, 2)]))))));
    const file = URL.createObjectURL(new Blob([`${JSON.stringify(found, null, 2)}\n`], { type: "application/json" }));
    parts.push(el("p", {}, el("a", { class: "button", href: file, download: "calibration.json" }, "calibration.json")),
      el("p", {}, tr("Put the file beside the rig's file, and enter it there: drive_data: {torque_calibration: calibration.json}. Each later run is then in calibrated N·m.")));
    return parts;
  }

  // -- many logs

  const FLEET = { running: tr("identifying"), done: tr("done"), interrupted: tr("ended early"), failed: tr("failed") };
  const asWhat = (settings) => english(Object.entries(settings).map(([name, value]) => `${name} ${value}`).join(", ")) || tr("as in each run");
  const stateOf = (one) => (one.held ? tr("waiting: a shaft turns, or a drive is in use") : FLEET[one.state]) + (one.total ? `: ${tr("{done} of {total} logs", { done: one.done, total: one.total })}` : "") + (one.failed ? `, ${tr("{count} failed", { count: one.failed })}` : "");

  function fleetsPage() {
    const form = byId("ask");
    let shown = "";
    if (form) call("GET", "/fleets/folders").then((folders) => show(form.elements.folder, ...folders.map((one) => el("option", { value: one }, one || tr("the runs of this service")))), () => {});
    if (form) form.addEventListener("submit", (event) => {
      event.preventDefault();
      submits(form, byId("said"), async () => {
        const found = await call("POST", "/fleets", asked(form));
        location.assign(`/fleets/${found.id}`);
      });
    });
    every(2000, async () => {
      const found = await call("GET", "/fleets"), now = JSON.stringify(found);
      if (now === shown) return;
      shown = now;
      show(byId("fleets"), ...(found.length ? found.map((one) => el("tr", {}, el("th", { scope: "row" }, el("a", { href: `/fleets/${one.id}` }, when(one.asked))),
        el("td", {}, one.folder || tr("the runs of this service"), one.below ? `, ${one.below}` : "", one.archived ? `, ${tr("archived too")}` : "", one.rehearsals ? `, ${tr("rehearsals too")}` : ""), el("td", {}, asWhat(one.settings)), el("td", {}, stateOf(one))))
        : [el("tr", {}, el("td", { colspan: 4, class: "dim" }, tr("none yet")))]));
    });
  }

  function fleetRow(row) {
    const own = /^runs\/([0-9]{8}-[0-9]{6}-[0-9a-f]{6})\/run\.mcap$/.exec(row.log);
    const J = interval(row.inertia_kg_m2, row.inertia_low_total_kg_m2, row.inertia_high_total_kg_m2) ?? "–";
    const was = row.changed ? tr("other: {verdict} {inertia}", { verdict: word(row.stored_verdict, "verdict"), inertia: number(row.stored_inertia_kg_m2) }) : row.changed === false ? tr("the same") : "";
    return el("tr", row.error_kind ? { class: "refused" } : {}, el("th", { scope: "row" }, own ? el("a", { href: `/runs/${own[1]}` }, own[1]) : row.log),
      el("td", {}, row.rig || "", " ", badge(row.simulated) || "", " ", rehearsal(row.rehearsed_faults) || ""), el("td", {}, when(row.date)), el("td", {}, row.error_kind ? english(`${row.error_kind}: ${row.error_text}`) : `${word(row.verdict, "verdict")}${inPart(row)}`), el("td", {}, J), el("td", {}, was));
  }

  // as FleetRow.part_text; older rows have no such field
  function inPart(row) {
    if (row.aborted_stage || row.aborted_by) return `, ${row.aborted_stage ? tr("aborted in stage {stage}", { stage: word(row.aborted_stage, "stage") }) : tr("aborted")}${row.aborted_by ? ` (${row.aborted_by})` : ""}`;
    return row.complete === false ? `, ${tr("log cut short")}` : "";
  }

  function fleetSummary(found) {
    const counts = [...Object.entries(found.verdicts).map(([verdict, count]) => [word(verdict, "verdict"), count]), ...Object.entries(found.failed).map(([kind, count]) => [tr("failed: {kind}", { kind }), count])];
    const more = [[tr("from a part of the run"), (found.in_part || []).length], [tr("finished before"), found.done_before], [tr("different from the result in the log"), found.changed.length], [tr("skipped: being written"), found.live], [tr("skipped: CSV without a .yaml"), found.bare_traces], [tr("rehearsals, left out"), found.rehearsals], [tr("remaining"), found.left]].filter(([, count]) => count);
    return [el("h2", {}, tr("Summary")), el("div", { class: "two" },
      region(tr("Number of logs"), el("table", {}, el("tbody", {}, ...[...counts, ...more].map(([name, count]) => line(name, [String(count)]))))),
      el("div", {}, el("p", {}, tr("{count} logs in {time}, {cpu} of processor time.", { count: found.logs, time: span(found.wall_s), cpu: span(found.cpu_s) })),
        found.slowest.length ? numbers(tr("The slowest"), [tr("log"), tr("processor time, s")], found.slowest.map((one) => [one.log, fixed(one.cpu_s, 2)])) : null))];
  }

  function fleetPage() {
    const id = document.body.dataset.fleet, said = byId("said");
    let count = 0, state = null, wanted = 200, view = null;
    async function rows() {
      if (count >= wanted) return;
      const found = await call("GET", `/fleets/${id}/rows?from=${count}&limit=${Math.min(200, wanted - count)}`);
      count += found.length;
      byId("rows").append(...found.map(fleetRow));
      byId("more").hidden = count < wanted;
    }
    every(1000, async () => {
      view = await call("GET", `/fleets/${id}`);
      if (state !== null && view.state !== state) { count = 0; byId("rows").replaceChildren(); }      // the table also has the earlier rows
      state = view.state;
      const going = state === "running";
      byId("state").textContent = stateOf(view) + (going && view.left_s !== null ? `, ${tr("about {time} left", { time: span(view.left_s) })}` : "");
      byId("progress").max = view.total || 1;
      byId("progress").value = view.done;
      byId("end").hidden = !going || !may("operator");
      byId("again").hidden = going || !may("operator");
      byId("table").hidden = going || !view.summary;
      said.hidden = !view.error;
      said.textContent = view.error ? errorText(view.error) : "";
      if (going || !view.summary) show(byId("summary")); else if (!byId("summary").firstChild) show(byId("summary"), ...fleetSummary(view.summary));
      await rows();
    });
    const press = async (work) => {
      try { await work(); } catch (error) { away(whyOf(error)); }
    };
    byId("end").addEventListener("click", () => press(() => call("POST", `/fleets/${id}/stop`, {})));
    byId("again").addEventListener("click", () => press(() => call("POST", "/fleets", { folder: view.folder, below: view.below, archived: view.archived, rehearsals: view.rehearsals, ...view.settings })));
    byId("more").addEventListener("click", () => press(() => { wanted += 200; return rows(); }));
  }

  Object.assign(pages, { run: runPage, runs: runsPage, history: historyPage, compare: comparePage, calibrate: calibratePage, rehearse: rehearsePage, fleets: fleetsPage, fleet: fleetPage });
})();
