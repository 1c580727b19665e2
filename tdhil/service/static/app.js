// The pages of tdhil serve. Data from elsewhere are inserted as text, never as markup.
"use strict";
(() => {
  const { byLabels, english, errorText, fixed, local, point, precise, tick, tr, word, worded } = window.tdhilLanguage;
  const API = "/api/v1";
  const PACE_S = 3;            // shortest time in which the pace of a simulated run is measured
  const SILENT_MS = 2000;      // without an answer in this time, a stop counts as not delivered and values as old
  const UNDELIVERED = tr("NOT DELIVERED: use the hard-wired emergency stop");
  const ENDED = ["done", "refused", "stopped", "failed", "stop_not_confirmed", "interrupted"];
  const STATES = {
    requested: tr("requested"), preflight: tr("preflight"), awaiting_confirmation: tr("waiting for the code"),
    moving: tr("moving"), stopping: tr("stopping"), identifying: tr("identifying"), done: tr("done"), refused: tr("refused"),
    stopped: tr("stopped"), failed: tr("failed"), stop_not_confirmed: tr("STOP NOT CONFIRMED"),
    interrupted: tr("interrupted"),
  };
  /** The state of a run, with what is known of its standstill. A list does not know it. */
  function stateText(state, stop, history) {
    if (state !== "stopped" && state !== "failed") return STATES[state] || state;
    if (stop.confirmed) return state === "stopped" ? tr("stopped, at standstill") : tr("failed, at standstill");
    if (history.some((one) => one.state === "moving")) return STATES[state];
    return state === "stopped" ? tr("stopped before motion") : tr("failed before motion");
  }
  const OLD = tr("No connection to tdhil serve: the values are old, and Stop on this page may not arrive. A shaft may still turn. To stop it, use the hard-wired emergency stop.");
  const byId = (id) => document.getElementById(id);

  /** Make an element with attributes, texts and child elements. */
  function el(tag, attributes = {}, ...inside) {
    const found = document.createElement(tag);
    for (const [name, value] of Object.entries(attributes)) {
      if (name === "onclick") found.addEventListener("click", value);
      else if (value === true) found.setAttribute(name, "");
      else if (value !== null && value !== undefined && value !== false) found.setAttribute(name, value);
    }
    found.append(...inside.filter((one) => one !== null && one !== undefined));
    return found;
  }
  const show = (where, ...inside) => where.replaceChildren(...inside.filter((one) => one !== null && one !== undefined));

  /** Value of a CSS variable: colours follow light and dark. */
  const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  /** Axis of a uPlot chart in the page's colours. */
  const axis = (more) => ({ stroke: colour("--dim"), grid: { stroke: colour("--line"), width: 1 }, ticks: { stroke: colour("--line") }, values: (self, all) => all.map(tick), ...more });

  class Refused extends Error {}

  const STARTED = "tdhil-started";
  /** Go to the live page of a run that was started here. It becomes the result, also if the run has ended by then. */
  function follow(run) {
    try { sessionStorage.setItem(STARTED, run); } catch (error) { /* as of a run that was started elsewhere */ }
    location.assign(`/runs/${run}/live`);
  }

  const may = (role) => (document.body.dataset.roles || "").split(" ").includes(role);

  /** Return the present token for a change: another page may have logged in again meanwhile. */
  function csrf() {
    const name = `__Host-tdhil-csrf-${location.port || 443}=`;
    const found = document.cookie.split("; ").find((one) => one.startsWith(name));
    return found ? { "X-CSRF-Token": found.slice(name.length) } : {};
  }

  async function call(method, path, body, headers = {}, withinMs = 15000, keepalive = false) {
    const abort = new AbortController();
    const timer = setTimeout(() => abort.abort(), withinMs);
    try {
      const answer = await fetch(API + path, {
        method, keepalive, signal: abort.signal,
        headers: body === undefined ? headers : { "Content-Type": "application/json", ...csrf(), ...headers },
        body: body === undefined ? undefined : JSON.stringify(body),
      });
      const found = await answer.json();
      if (answer.status === 401 && document.body.dataset.page !== "login") loggedOut();
      if (!answer.ok) throw Object.assign(new Refused(found.error ? errorText(found.error) : `HTTP ${answer.status}`), { fields: found.fields || [], status: answer.status });
      return found;
    } finally {
      clearTimeout(timer);
    }
  }

  let outside = false;
  function away(...parts) {
    if (outside) return;
    const bar = byId("away"), made = el("span", {}, ...parts.filter(Boolean));
    bar.hidden = !made.textContent;
    if (bar.textContent !== made.textContent) bar.replaceChildren(...made.childNodes);
  }

  /** Keep the page and its Stop. Only a request for another page leads to the login. */
  function loggedOut() {
    if (outside) return;
    const there = encodeURIComponent(location.pathname + location.search);
    away("");
    outside = true;
    byId("away").hidden = false;
    show(byId("away"), `${tr("Your login has ended: the values are old. Stop may still work, and this page reports the result. If not, use the hard-wired emergency stop.")} `, el("a", { href: `/login?next=${there}` }, tr("Log in")));
    document.body.classList.add("stale");
  }

  /** Repeat a request. Grey the page while no answer comes. */
  function every(ms, look) {
    let last = Date.now();
    const go = async () => {
      try {
        await look();
        last = Date.now();
      } catch (error) {
        if (error instanceof Refused) away(error.message);
      }
      setTimeout(go, ms);
    };
    go();
    setInterval(() => {
      const silent = Date.now() - last > ms + SILENT_MS;
      document.body.classList.toggle("stale", silent);
      if (silent && !byId("away").textContent.includes(UNDELIVERED)) away(OLD);
      else if (byId("away").textContent === OLD) away("");
    }, 500);
  }

  const number = (value, digits = 4) => (value === null || value === undefined ? "–" : local(Number(value).toPrecision(digits).replace(/\.?0+$/, (m) => (m.includes(".") ? "" : m))));
  /** Round a value and its interval as the terminal's card: two digits of the half-width, and more; tens and hundreds too. */
  function rounded(value, low, high, more = 0) {
    const half = (high - low) / 2, places = half > 0 ? Math.min(12, 1 - Math.floor(Math.log10(half)) + more) : 4, step = 10 ** -places;
    // the ends are rounded outwards; 1e-6 of the last digit is the rounding of the arithmetic
    const whole = { value: places < 0 ? Math.round(value / step) * step : value, low: Math.floor(low / step + 1e-6) * step, high: Math.ceil(high / step - 1e-6) * step };
    return { places: Math.max(0, places), ...whole };
  }
  function interval(value, low, high, more = 0) {
    if (value === null || value === undefined) return null;
    if (low === null || low === undefined || high === null || high === undefined) return number(value);
    if (low === high) return number(value, 5 + more);
    const at = rounded(value, low, high, more);
    return tr("{value} ({low} to {high})", { value: fixed(at.value, at.places), low: fixed(at.low, at.places), high: fixed(at.high, at.places) });
  }
  const withUnit = (text) => (text === null ? null : `${text} kg·m²`);
  const inertia = (one) => (one ? withUnit(interval(one.inertia_kg_m2, one.low_kg_m2, one.high_kg_m2)) : null);
  function ofResult(result) {
    const J = result && result.inertia_kg_m2;
    return J ? withUnit(interval(J.value, J.low_total, J.high_total)) : null;
  }
  // Speeds are shown in the unit that the reader has chosen. Data and files have rad/s.
  const RPM = 60 / (2 * Math.PI), UNIT_KEY = "tdhil-speed-unit", redo = [];
  let inRpm = false;
  try { inRpm = localStorage.getItem(UNIT_KEY) === "rpm"; } catch (error) { /* then rad/s */ }
  const speedUnit = () => (inRpm ? tr("rpm") : "rad/s");
  const inSpeedUnit = (value) => (inRpm ? RPM * value : value);
  const onSpeedUnit = (draw) => { redo.push(draw); };
  /** Make an element whose text contains speeds; the text follows the chosen unit. */
  function ofSpeed(text) {
    const found = el("span", {}, text());
    onSpeedUnit(() => { found.textContent = text(); });
    return found;
  }
  function speedUnits() {
    const button = byId("speed-unit");
    const inputs = [...document.querySelectorAll("[data-speed-input]")];
    const label = () => {
      for (const one of inputs) one.dataset.unit = inRpm ? "rpm" : "rad/s";
      button.textContent = speedUnit();
      button.setAttribute("aria-label", tr("Speeds in {unit}. Change to {other}", { unit: speedUnit(), other: inRpm ? "rad/s" : tr("rpm") }));
      for (const one of document.querySelectorAll("[data-speed-unit]")) one.textContent = speedUnit();
      for (const one of document.querySelectorAll("[data-speed]")) one.textContent = number(inSpeedUnit(Number(one.dataset.speed)), 3);
    };
    label();
    button.addEventListener("click", () => {
      for (const one of inputs) {                  // a typed speed stays the same speed
        const typed = point(one.value);
        if (/^[-+]?(\d+\.?\d*|\.\d+)$/.test(typed)) one.value = local(String(Number((inRpm ? Number(typed) / RPM : Number(typed) * RPM).toPrecision(6))));
      }
      inRpm = !inRpm;
      try { localStorage.setItem(UNIT_KEY, inRpm ? "rpm" : "rad/s"); } catch (error) { /* then for this page only */ }
      label();
      redo.forEach((draw) => draw());
    });
  }
  /** Format half of an interval as a share: two digits, rounded up, as on the terminal's card and in the report. */
  function percent(share) {
    if (share === null || share === undefined) return "";
    const found = 100 * share, step = found > 0 ? 10 ** (Math.floor(Math.log10(found)) - 1) : 1;
    return `±${precise(Math.ceil(found / step - 1e-6) * step, 2)} %`;
  }
  const ASYMMETRIC = 1.2;            // as in report/intervals.py
  /** Half of an interval as a share of its value; '' if one side is clearly longer than the other. */
  function shareOf(value, low, high) {
    const sides = [value - low, high - value];
    return Math.max(...sides) > ASYMMETRIC * Math.min(...sides) ? "" : percent(Math.max(...sides) / Math.abs(value));
  }
  /** Format local time with an unambiguous month. */
  const two = (one, digits = 2) => String(one).padStart(digits, "0");
  const time = (at) => `${two(at.getHours())}:${two(at.getMinutes())}:${two(at.getSeconds())}`;
  const clock = (iso) => (iso ? `${time(new Date(iso))}.${two(new Date(iso).getMilliseconds(), 3)} ${zone(new Date(iso))}` : "");
  function when(iso) {
    if (!iso) return "";
    const at = new Date(iso);
    return Number.isNaN(at.getTime()) ? iso : `${at.getFullYear()}-${two(at.getMonth() + 1)}-${two(at.getDate())} ${time(at)} ${zone(at)}`;
  }
  /** Return the offset of local time: files and the terminal may show another one. */
  function zone(at) {
    const minutes = -at.getTimezoneOffset(), away = Math.abs(minutes);
    return minutes === 0 ? "UTC" : `UTC${minutes < 0 ? "-" : "+"}${two(Math.floor(away / 60))}:${two(away % 60)}`;      // as in reports
  }
  /** Return a quantity as typed, with this unit if it has none. The service checks it. */
  function quantity(text, unit) {
    const typed = point(text);
    return /[\d.]$/.test(typed) && unit !== "1" ? typed + unit : typed;
  }
  function span(seconds) {
    const whole = Math.max(0, Math.round(seconds));
    return whole < 90 ? `${whole} s` : `${Math.floor(whole / 60)} min ${String(whole % 60).padStart(2, "0")} s`;
  }
  /** Show what is waited for, since when, and how much of its usual time is over. Return how the wait is ended. */
  function waiting(where, text, kind, sinceMs = Date.now()) {
    const key = `tdhil-took-${kind}`, bar = el("progress", { "aria-label": text }), line = el("p", { class: "dim", role: "status" }, text);
    let usual = null;
    try { usual = Number(localStorage.getItem(key)) || null; } catch (error) { /* then no usual time is known */ }
    if (usual) bar.max = usual;
    const tick = () => {
      const ms = Date.now() - sinceMs;
      if (usual && ms < usual) bar.value = ms; else bar.removeAttribute("value");       // longer than usual: it goes on
      line.textContent = `${text}: ${span(ms / 1000)}${usual ? ` ${tr("of about {time}", { time: span(usual / 1000) })}` : ""}`;
    };
    tick();
    const timer = setInterval(tick, 500);
    show(where, line, bar);
    return (done) => {
      clearInterval(timer);
      if (done) try { localStorage.setItem(key, String(Date.now() - sinceMs)); } catch (error) { /* as above */ }
    };
  }
  const rehearsal = (yes) => (yes ? el("span", { class: "badge" }, tr("REHEARSAL")) : null);
  const uploaded = (yes) => (yes ? el("span", { class: "badge" }, tr("UPLOADED")) : null);
  const badge = (simulated) => (simulated ? el("span", { class: "badge" }, tr("SIMULATED")) : null);

  // -- rigs

  function rigCard(rig) {
    const mayWatch = Boolean(document.body.dataset.known);
    const said = {
      free: rig.simulated || rig.motion === "attended" ? tr("free") : rig.motion === "never" ? tr("free; can't be moved from here (service.motion: {rule})", { rule: rig.motion })
        : mayWatch ? tr("free") : tr("free; moves only while a logged-in user watches it (service.motion: {rule})", { rule: rig.motion }),
      busy: tr("in use by a run"), held: tr("held by {holder}", { holder: rig.holder }), blocked: tr("blocked: a stop was not confirmed"), unusable: english(rig.problem),
    }[rig.state];
    const mayStart = may("operator") && rig.state === "free" && (rig.simulated || rig.motion === "attended" || (rig.motion === "watched" && mayWatch));
    return el("article", { class: "card", "aria-labelledby": `rig-${rig.id}` },
      el("h2", { id: `rig-${rig.id}` }, rig.name, " ", badge(rig.simulated) || ""),
      el("p", { class: rig.state === "blocked" || rig.state === "unusable" ? "alarm" : "dim" }, said),
      rig.last ? el("p", {}, el("span", { class: "figure" }, `J = ${inertia(rig.last)}`), " ", (!rig.simulated && badge(rig.last.simulated)) || "", el("br"), el("a", { href: `/runs/${rig.last.id}` }, when(rig.last.asked)), rig.last.state === "done" ? "" : ` · ${STATES[rig.last.state] || rig.last.state}`) : el("p", { class: "dim" }, tr("no result yet")),
      el("p", { class: "row" },
        mayStart ? el("a", { class: "button", href: `/start/${encodeURIComponent(rig.id)}` }, tr("Start")) : null,
        rig.run ? el("a", { class: "button", href: `/runs/${rig.run}/live` }, tr("Live")) : null,
        rig.run || rig.state === "held" || rig.blocked_by ? el("button", { type: "button", class: "danger", onclick: () => stopRig(rig) }, tr("Stop")) : null,
        may("operator") ? el("a", { class: "button quiet", href: `/calibrate/${encodeURIComponent(rig.id)}` }, tr("Calibrate")) : null,
        may("operator") && rig.simulated && rig.state === "free" ? el("a", { class: "button quiet", href: `/rehearse/${encodeURIComponent(rig.id)}` }, tr("Rehearse")) : null,
        rig.state !== "unusable" ? el("a", { class: "button quiet", href: `/rigs/${encodeURIComponent(rig.id)}` }, tr("History")) : null,
        may("engineer") ? el("a", { class: "button quiet", href: `/rigs/${encodeURIComponent(rig.id)}/file` }, tr("File")) : null,
        rig.blocked_by ? el("a", { class: "button", href: `/runs/${rig.blocked_by}` }, tr("Sign off")) : null));
  }

  /** Stop the drive of a rig; ``show`` displays what came of it. */
  async function stopRig(rig, show = away) {
    const late = setTimeout(() => show(tr("Stop of {rig}: standstill is not confirmed yet. If the shaft still turns, use the hard-wired emergency stop.", { rig: rig.name })), SILENT_MS);
    try {
      const found = await call("POST", `/rigs/${encodeURIComponent(rig.id)}/stop`, {}, {}, Number(document.body.dataset.stopS) * 1000 + 10000);      // a stop of the drive is answered after standstill
      show("");
      if (found.runs.length && !found.said) location.assign(`/runs/${found.runs[0]}/live`);
      else show(`${rig.name}: `, worded(found.said), found.exit_code === 0 ? "" : `. ${tr("Use the hard-wired emergency stop")}`);
    } catch (error) {
      show(`${tr("Stop of {rig} {problem}", { rig: rig.name, problem: UNDELIVERED })}${error instanceof Refused ? `. ${error.message}` : ""}`);
    } finally {
      clearTimeout(late);
    }
  }

  function rigsPage() {
    let shown = "";
    every(2000, async () => {
      const rigs = await call("GET", "/rigs");
      const now = JSON.stringify(rigs);
      if (now !== shown) show(byId("rigs"), ...rigs.map(rigCard));
      shown = now;
    });
  }

  // -- start

  /** Return the options of a form by field name, without empty fields. */
  function asked(form) {
    const found = {};
    for (const field of form.querySelectorAll("[name]:not(button)")) {
      const ticks = field.tagName === "FIELDSET" ? [...field.querySelectorAll(":checked")].map((one) => one.value).join(",") : null;
      const text = ticks ?? field.value.trim(), { kind, unit } = field.dataset;
      if (field.type === "checkbox") {
        if (field.checked) found[field.name] = true;
      } else if (text) {
        found[field.name] = unit ? quantity(text, unit) : kind === "tuple" ? text.split(/[\s,]+/)
          : kind === "pairs" ? text.split(/[\s,;]+(?=[\w-]+\s*=)/).map((one) => one.replaceAll(/(\d),(?=\d)/g, "$1."))
          : kind === "int" && /^-?\d+$/.test(text) ? Number(text) : kind === "float" ? point(text) : text;
      }
    }
    return found;
  }

  /** Mistakes in the order of their fields on the form; those without a field come last. */
  function inOrder(form, fields) {
    const all = [...form.elements], place = (one) => (form.elements[one.option] ? all.indexOf(form.elements[one.option]) : all.length);
    return [...fields].sort((one, other) => place(one) - place(other));
  }
  /** Mark a field as wrong. The text with this id describes it, before its help. */
  function invalid(field, id) {
    field.setAttribute("aria-invalid", "true");
    field.setAttribute("aria-describedby", field.dataset.about ? `${id} ${field.dataset.about}` : id);
  }
  /** Mark the fields whose values were refused, each with its reasons, and go to the first one if `go`. `said`: a reason of this page. */
  function markWrong(form, fields, go = true) {
    const known = inOrder(form, fields.filter((one) => form.elements[one.option]));
    known.forEach((one) => {
      const field = form.elements[one.option], id = `wrong-${one.option}`, why = one.said ?? worded(one.message), before = form.querySelector(`[id="${id}"]`);
      if (before) { before.append(`\n${why}`); return; }
      const note = el("span", { class: "alarm wrong", id }, why);
      invalid(field, id);
      (field.closest("label") || field).append(note);
      opens(field);
    });
    if (known.length && go) focus(form.elements[known[0].option]);
    return known.length;
  }
  /** Open what hides a field. */
  function opens(field) {
    for (let closed = field.closest("details"); closed; closed = closed.parentElement.closest("details")) closed.open = true;
  }
  const focus = (field) => (field.querySelector("input") || field).focus();
  /** Return a message, and mark the fields of this form whose labels it quotes: the text `said` describes them. */
  function marked(form, message, said, go = true) {
    const mine = [...form.querySelectorAll("[data-flag]")].filter((one) => message.includes(`“${one.dataset.label}”`));
    const fields = mine.map((one) => (one.name ? one : one.querySelector("[name]")));
    fields.forEach((one) => {
      invalid(one, said.id);
      opens(one);
    });
    if (fields.length && go) focus(fields[0]);
    return message;
  }
  /** Show a refusal, all at once: each wrong field of the form is marked with its reason, and the text `said` has the others. */
  function refused(form, said, error, go = true) {
    const fields = error.fields || [], others = fields.filter((one) => !form.elements[one.option]);
    if (others.length || !fields.length) tell(said, new Refused(fields.length ? others.map((one) => `${word(one.label)}: ${worded(one.message)}`).join("; ") : marked(form, whyOf(error), said, go)));
    markWrong(form, fields, go);
  }
  function unmark(form) {
    form.querySelectorAll("[aria-invalid]").forEach((one) => {
      one.removeAttribute("aria-invalid");
      if (one.dataset.about) one.setAttribute("aria-describedby", one.dataset.about); else one.removeAttribute("aria-describedby");
    });
    form.querySelectorAll(".wrong").forEach((one) => one.remove());
  }
  /** Text of an error: the refusal, or that there is no answer. */
  const whyOf = (error) => (error instanceof Refused ? error.message : tr("No answer from tdhil serve."));
  /** Show an error in this place. */
  function tell(where, error) {
    where.textContent = whyOf(error);
    where.hidden = false;
    where.scrollIntoView({ block: "nearest" });
  }
  const LEAVES = new Promise(() => {});       // what a form waits for whose page is loaded again
  const sending = new Set();
  /** Send a form, once for a double click. A refusal is shown at its fields, or in the text `said` if it names none of them. */
  async function submits(form, said, send) {
    if (sending.has(form)) return;
    sending.add(form);
    unmark(form);
    said.hidden = true;
    try {
      await send();
    } catch (error) {
      refused(form, said, error);
    } finally {
      sending.delete(form);
    }
  }

  /** Disable these elements of a form. Return the function that enables them again. */
  function closes(elements) {
    const open = [...elements].filter((one) => !one.disabled);
    open.forEach((one) => { one.disabled = true; });
    return () => open.forEach((one) => { one.disabled = false; });
  }
  /** Fill a form with what is stored. It takes no text before, since the answer would replace it. */
  async function fillsFirst(form, fill) {
    const opens = closes(form.elements);
    await fill();
    opens();
  }

  function planTable(plan) {
    const half = plan.expected_half_width, speed = (value) => number(inSpeedUnit(value), 3);
    const rows = [
      [tr("expected interval of J (repeatability)"), half === null ? tr("not predicted") : percent(half)],
      [tr("time"), tr("{time}, of which {part} are stage 5", { time: span(plan.duration_s + 90), part: span(plan.duration_s) })],
      [tr("motion"), tr("{excitation} in {mode} mode", { excitation: plan.excitation, mode: word(plan.mode, "mode") })],
      [tr("speed in stage 5"), ofSpeed(() => tr("{low} to {high} {unit} (limits {least} to {most})", { low: speed(plan.speed_rad_s.min), high: speed(plan.speed_rad_s.max), unit: speedUnit(), least: speed(plan.limits.speed_min_rad_s), most: speed(plan.limits.speed_max_rad_s) }))],
      [tr("torque in stage 5, N·m"), tr("{low} to {high} (limit ±{most})", { low: number(plan.torque_nm.min, 3), high: number(plan.torque_nm.max, 3), most: number(plan.limits.torque_nm, 3) })],
    ];
    const advice = plan.stopping && !plan.stopping.reachable ? el("p", { class: "alarm" }, `${tr("±{share} % can't be reached:", { share: number(100 * plan.stopping.tolerance, 3) })} `, english(plan.stopping.advice)) : null;
    return [
      el("table", {}, el("tbody", {}, ...rows.map(([name, text]) => el("tr", {}, el("th", { scope: "row" }, name), el("td", {}, text))))),
      advice || "",
      el("p", { class: "dim" }, tr("These values are assumed. A run first measures friction, inertia and noise, and then plans again.")),
    ];
  }

  /** Before a run by the clock: measure whether this computer sustains the rate, and say so. Return what a start waits for. */
  function pacing(rig, form) {
    const box = form.elements.real_time, where = byId("pace");
    if (!box || !where) return async () => true;
    const stepped = where.textContent;
    let measuring = null, warned = false;
    const measure = async () => {
      where.className = "dim";
      const over = waiting(where, tr("Measuring whether this computer sustains the cycle rate"), "pace");
      try {
        const { pace: found } = await call("GET", `/rigs/${encodeURIComponent(rig)}/pace`, undefined, {}, 60000);
        over(true);
        if (box.checked) {
          where.className = found.holds ? "" : "alarm";
          show(where, english(found.text));
        }
        return found.holds;
      } catch (error) {
        over(false);
        where.className = "alarm";
        where.textContent = error instanceof Refused ? error.message : tr("The cycle rate could not be measured.");
        return false;
      }
    };
    box.addEventListener("change", () => {
      warned = false;
      measuring = box.checked ? measure() : null;
      if (!box.checked) { where.className = "dim"; where.textContent = stepped; }
    });
    return async () => {             // a second request starts all the same
      if (!box.checked || warned || await (measuring ||= measure())) return true;
      warned = true;
      where.append(` ${tr("Request it again to run anyway.")}`);
      const closed = where.closest("details");
      if (closed) closed.open = true;
      where.scrollIntoView({ block: "center" });
      return false;
    };
  }

  /** The first run of a new rig: its steps, and a motion in the lower part of the speed window. */
  function firstMotion(form, steps) {
    steps.hidden = false;
    const field = form.elements.highest_speed_rad_s;
    if (!field.value) field.value = local(String(Number(inSpeedUnit(Number(steps.dataset.highest)).toPrecision(3))));
    opens(field);
  }

  const CHECK_MS = 130000;     // the service ends a check after 120 s
  /** Check the drive without motion: each finding with its result in words. */
  function driveCheck(rig) {
    const button = byId("check-drive"), where = byId("check-said");
    const results = { ok: ["ok", tr("pass")], note: ["note", tr("for information")], bad: ["refused", tr("fail")] };
    button.addEventListener("click", async () => {
      button.disabled = true;
      const over = waiting(where, tr("Checking"), "check");
      try {
        const checks = await call("POST", `/rigs/${encodeURIComponent(rig)}/check`, {}, {}, CHECK_MS);
        over(true);
        const failed = checks.filter((one) => one.grade === "bad").length;
        show(where,
          el("p", { class: failed ? "alarm" : "verdict good", role: "status" }, failed ? tr("Failed: {count} of {all} checks. Correct them before the first motion.", { count: failed, all: checks.length }) : tr("No check failed. Nothing has moved.")),
          scrolls(el("div", { class: "scroll", tabindex: "0", role: "region", "aria-label": tr("Findings of the check") }, el("table", {},
            el("thead", {}, el("tr", {}, ...[tr("result"), tr("check"), tr("found"), tr("what to do")].map((text) => el("th", { scope: "col" }, text)))),
            el("tbody", {}, ...checks.map((one) => el("tr", { class: results[one.grade][0] }, el("td", {}, results[one.grade][1]), el("th", { scope: "row" }, english(one.name)), el("td", {}, english(one.said)), el("td", {}, english(one.do)))))))));
      } catch (error) {
        over();
        show(where, el("p", { class: "alarm", role: "alert" }, whyOf(error)));
      } finally {
        button.disabled = false;
      }
    });
  }

  const PLAN_MS = 300000;      // a narrow tolerance on a computer under load
  function startPage() {
    const rig = document.body.dataset.rig;
    const form = byId("ask");
    if (!form) return;
    const paced = pacing(rig, form);
    driveCheck(rig);
    if (byId("first") && new URLSearchParams(location.search).get("first") === "true") firstMotion(form, byId("first"));
    let key = null, keyFor = "";
    /** Say an error, and mark the fields that it names. */
    function refuse(message, fields = []) {
      byId("plan").hidden = true;            // the plan of other values
      if (fields.length) {
        show(byId("said"), el("div", { class: "alarm", role: "alert" }, el("p", {}, fields.length === 1 ? tr("One value can't be used. Nothing was started.") : tr("{count} values can't be used. Nothing was started.", { count: fields.length })),
          el("ul", {}, ...inOrder(form, fields).map((one) => el("li", {}, el("strong", {}, word(one.label)), ": ", worded(one.message))))));
        markWrong(form, fields);
        return;
      }
      show(byId("said"), el("p", { class: "alarm", role: "alert" }, marked(form, message, byId("said"))));
    }
    every(3000, async () => {
      const found = await call("GET", `/rigs/${encodeURIComponent(rig)}`);
      const why = { busy: tr("A run uses this rig."), held: tr("Held by {holder}.", { holder: found.holder }), blocked: tr("Blocked until a stop that was not confirmed is signed off.") }[found.state];
      byId("rig-state").textContent = why || "";
    });
    form.addEventListener("input", () => { byId("plan").hidden = true; });
    form.addEventListener("submit", async (event) => {
      event.preventDefault();
      const wanted = event.submitter && event.submitter.value === "plan" ? "plan" : "start";
      const buttons = [...form.querySelectorAll("button")];
      const options = asked(form);
      buttons.forEach((one) => { one.disabled = true; });
      unmark(form);
      const over = wanted === "plan" ? waiting(byId("said"), tr("Planning"), "plan") : () => {};
      if (wanted === "plan") byId("plan").hidden = true; else show(byId("said"), el("p", { class: "dim" }, tr("Requesting …")));
      let planned = false;
      try {
        if (wanted === "plan") {
          const found = await call("POST", `/rigs/${encodeURIComponent(rig)}/plan`, options, {}, PLAN_MS);
          show(byId("plan").lastElementChild, ...planTable(found.plan));
          byId("plan").hidden = JSON.stringify(asked(form)) !== JSON.stringify(options);      // changed meanwhile
          planned = true;
          show(byId("said"));
        } else if (!await paced()) {
          show(byId("said"));
        } else {
          const text = JSON.stringify(options);         // the same request twice starts one run
          if (key === null || keyFor !== text) { key = crypto.randomUUID(); keyFor = text; }
          const run = await call("POST", `/rigs/${encodeURIComponent(rig)}/runs`, options, { "Idempotency-Key": key });
          follow(run.id);
        }
      } catch (error) {
        refuse(whyOf(error), error.fields);
      } finally {
        over(planned);
        buttons.forEach((one) => { one.disabled = false; });
      }
    });
  }

  const sideways = new ResizeObserver((found) => {
    for (const { target } of found) target.classList.toggle("wider", target.scrollWidth > target.clientWidth + 1);
  });
  /** Mark a part of the page while it is wider than the screen: CSS then shows that it scrolls. */
  function scrolls(part) {
    part.dataset.hint = tr("Wider than the screen: scroll sideways →");
    sideways.observe(part);
    return part;
  }

  // -- live

  /** Receive the live messages of a run. A connection that ends is made again while ``goesOn`` is true. */
  function listen(run, take, goesOn = () => true) {
    const socket = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}${API}/live/${run}`);
    socket.addEventListener("message", (event) => { if (goesOn()) take(JSON.parse(event.data)); else socket.close(); });
    socket.addEventListener("close", (event) => {
      if (event.code === 4401) loggedOut();
      else if (goesOn()) setTimeout(() => listen(run, take, goesOn), 700);
    });
  }
  /** Show J from the periods so far: the latest interval, and what belongs to it. Return whether J is known. */
  function inertiaNow(inertias) {
    const last = inertias[inertias.length - 1], known = inertias.filter((one) => one.inertia_kg_m2 !== null).pop();
    byId("inertia-now").textContent = known ? withUnit(interval(known.inertia_kg_m2, known.low_kg_m2, known.high_kg_m2)) : "–";
    const words = [last.periods === 1 ? tr("1 period") : tr("{count} periods", { count: last.periods })];
    if (known) words.push(percent((known.high_kg_m2 - known.low_kg_m2) / 2 / known.inertia_kg_m2));
    if (last.p_value !== null) words.push(`p = ${number(last.p_value, 2)}`);
    if (last.tolerance !== null && last.least_left_s !== null) words.push(tr("at least {time} to ±{share} %", { time: span(last.least_left_s), share: local(String(Number((100 * last.tolerance).toPrecision(3)))) }));
    if (last.inertia_kg_m2 === null) words.push(byLabels(last.reason));
    byId("inertia-said").textContent = words.join(", ");
    byId("inertia-row").hidden = false;
    return Boolean(known);
  }

  /** When a stop was asked for, when the drive reacted, and when it stood still. */
  function stopSteps(stop, asking = false) {
    const steps = [];
    if (asking && !stop.asked) steps.push(el("li", {}, tr("requesting …")));
    if (stop.asked) steps.push(el("li", {}, tr("stop requested {time}", { time: clock(stop.asked) })));
    if (stop.asked && stop.seen) steps.push(el("li", {}, tr("→ stop sent, drive replied {time}", { time: clock(stop.seen) })));
    if (stop.at_rest) steps.push(el("li", {}, `${stop.asked ? "→ " : ""}${tr("standstill {time}", { time: clock(stop.at_rest) })}`));
    if (stop.confirmed === false) steps.push(el("li", { class: "alarm" }, tr("Standstill NOT confirmed: use the hard-wired emergency stop")));
    return steps;
  }
  const unwatched = (watch) => tr("This run was not watched: braking began at {time}.", { time: clock(watch.lost) });
  /** The text of an event, in one line. */
  const eventText = (one) => [one.time_s === null ? "" : `${fixed(one.time_s, 1)} s `, english(`${one.text.startsWith(`${one.kind}:`) ? "" : `${one.kind}: `}${one.text}`)];

  /** Draw J's interval over time: inner band without, outer band with the torque scale; dashed: --tolerance about the last J. */
  function inertiaPlot(where) {
    let known = [];
    const chart = { where, plot: null, title: () => where.parentElement.querySelector("figcaption").textContent };
    const { nearest, reading, toolbar, viewOf } = window.tdhil, read = reading(where, (at) => {
      const one = known[nearest(known.map((each) => each.time_s), at)];
      if (!one) return "–";
      const said = tr("{time} s: J = {inertia} kg·m²", { time: fixed(one.time_s, 1), inertia: interval(one.inertia_kg_m2, one.low_kg_m2, one.high_kg_m2) });
      const total = interval(one.inertia_kg_m2, one.low_total_kg_m2, one.high_total_kg_m2);
      return total.includes("(") ? tr("{reading}, with the torque scale {inertia}", { reading: said, inertia: total }) : said;
    });
    const data = () => ["time_s", "high_total_kg_m2", "low_total_kg_m2", "high_kg_m2", "low_kg_m2", "inertia_kg_m2"].map((name) => known.map((one) => one[name]));
    const COLUMNS = ["time_s", "inertia_kg_m2", "low_kg_m2", "high_kg_m2", "low_total_kg_m2", "high_total_kg_m2"];
    const view = viewOf([chart], {
      tools: toolbar(where, tr("Interval of J over time")), least: 1, file: () => `${document.body.dataset.run}-inertia`,
      whole: () => {      // uPlot would begin at 0 for a single answer
        const low = known[0]?.time_s ?? 0, high = known[known.length - 1]?.time_s ?? 0, pad = 0.04 * (high - low) || 5;
        return [low - pad, high + pad];
      },
      table: ([low, high]) => [COLUMNS.join(), ...known.filter((one) => one.time_s >= low && one.time_s <= high).map((one) => COLUMNS.map((name) => one[name] ?? "").join())],
    });
    const draw = () => {
      if (chart.plot) chart.plot.destroy();
      const shade = colour("--c2"), edge = (width) => ({ stroke: shade, width, points: { show: false } });
      chart.plot = new uPlot({
        width: where.clientWidth || 320, height: 190, legend: { show: false }, cursor: { ...read.cursor, ...view.cursor },
        scales: { x: { time: false, range: () => view.range() } },
        axes: [axis({ size: 34, values: (self, all) => all.map((one) => `${tick(one)} s`) }), axis({ size: 52 })],
        series: [{}, edge(0), edge(0), edge(1), edge(1), { stroke: shade, width: 2, points: { show: true, size: 7, fill: shade } }],
        bands: [{ series: [1, 2], fill: `${shade}22` }, { series: [3, 4], fill: `${shade}44` }],
        hooks: { setCursor: read.setCursor, setSelect: view.setSelect, draw: [(self) => {
          const last = known[known.length - 1];
          if (!last) return;
          const c = self.ctx;
          c.save();
          c.beginPath(); c.rect(self.bbox.left, self.bbox.top, self.bbox.width, self.bbox.height); c.clip();
          c.strokeStyle = shade;
          c.lineWidth = 1.5 * devicePixelRatio;
          for (const one of known.filter((each) => each.low_kg_m2 !== null && each.high_kg_m2 !== null)) {   // a band alone shows nothing of the first answer
            const x = self.valToPos(one.time_s, "x", true);
            c.beginPath(); c.moveTo(x, self.valToPos(one.low_kg_m2, "y", true)); c.lineTo(x, self.valToPos(one.high_kg_m2, "y", true)); c.stroke();
          }
          if (!last.tolerance) { c.restore(); return; }
          c.strokeStyle = colour("--limit");
          c.setLineDash([6 * devicePixelRatio, 4 * devicePixelRatio]);
          for (const sign of [-1, 1]) {
            const y = self.valToPos(last.inertia_kg_m2 * (1 + sign * last.tolerance), "y", true);
            if (y < self.bbox.top || y > self.bbox.top + self.bbox.height) continue;
            c.beginPath(); c.moveTo(self.bbox.left, y); c.lineTo(self.bbox.left + self.bbox.width, y); c.stroke();
          }
          c.restore();
        }] },
      }, data(), where);
      view.again();
    };
    new ResizeObserver(() => chart.plot && chart.plot.setSize({ width: where.clientWidth || 320, height: 190 })).observe(where);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => chart.plot && draw());
    return (all) => {
      known = all.filter((one) => one.inertia_kg_m2 !== null);
      if (!chart.plot) draw(); else chart.plot.setData(data());
    };
  }

  function livePage() {
    const run = document.body.dataset.run, watched = document.body.dataset.motion === "watched";
    const samples = [[], [], []];
    let status = null, message = 0, age = null, timeS = null, dirty = false, asking = null, undelivered = "", unseen = null, tooLate = false;
    let wentOn = false;                                // true if the page was opened for the run, not for its record
    try { wentOn = sessionStorage.getItem(STARTED) === run; } catch (error) { /* then a run that ended at once is not followed */ }
    const charts = window.tdhil.motion(run);

    let inertias = [], drawInertia = null;
    /** Show J from the periods so far: the latest as figures, all of them as a graph. */
    function drawn() {
      const known = inertiaNow(inertias);
      byId("inertia").hidden = !known;
      if (!known) return;
      drawInertia ||= inertiaPlot(byId("plot-inertia"));
      drawInertia(inertias);
    }

    function take(found) {
      message = Date.now();
      age = found.age_s;
      timeS = found.time_s;
      if (found.type === "hello") samples.forEach((one) => { one.length = 0; });
      if (found.type === "hello") { byId("events").replaceChildren(); byId("stages").dataset.done = ""; done = {}; }
      if (found.samples) { found.samples.forEach((column, k) => { for (const one of column) samples[k].push(one); }); dirty = true; }
      for (const one of found.events || []) event(one);
      for (const one of found.stages || []) done[one.name] = one;
      if (found.type === "hello") inertias = [];
      if (found.inertias && found.inertias.length) { inertias.push(...found.inertias); drawn(); }
      if (found.limits) charts.limit(found.limits);
      if (found.status) { status = found.status; state(); }
      if (found.stages || found.status) stages();
      if (found.stages) charts.stages(Object.values(done));
    }
    let done = {};

    function event(one) {
      const list = byId("events");
      if (one.kind === "preflight") return;
      list.prepend(el("li", {}, ...eventText(one)));
      while (list.children.length > 200) list.lastElementChild.remove();
    }

    function stages() {
      if (!status) return;
      const names = Object.keys((status && status.expected_s) || {});
      show(byId("stages"), ...names.map((name) => {
        const one = done[name];
        const current = status.state === "moving" && status.stage === name;
        const text = one ? `${{ ok: "✓", skipped: "–", aborted: "✗" }[one.outcome] || "~"} ${word(name, "stage")}, ${span(one.end_s - one.start_s)}${one.outcome === "ok" ? "" : `, ${word(one.outcome, "outcome")}`}` : `${current ? "▸" : "·"} ${tr("{stage}, about {time}", { stage: word(name, "stage"), time: span(status.expected_s[name]) })}`;
        return el("li", current ? { "aria-current": "step" } : {}, text);
      }));
    }

    let began = null;
    /** Seconds of the run in a second of the clock: more than 1 in stepped time; null before it is known. */
    function pace() {
      if (!status.simulated) return 1;
      if (timeS === null) return null;
      began ||= { clock: Date.now(), timeS };
      const passed = (Date.now() - began.clock) / 1000;
      return passed > PACE_S && timeS > began.timeS ? (timeS - began.timeS) / passed : null;
    }

    /** Time that the run still takes, in seconds of the clock. */
    function leftS() {
      if (!status || status.state !== "moving" || pace() === null) return null;
      const since = Math.max(0, ...Object.values(done).map((one) => one.end_s));
      let left = 0, after = false;
      for (const [name, expected] of Object.entries(status.expected_s)) {
        if (name === status.stage) { after = true; left += Math.max(0, expected - Math.max(0, (timeS ?? since) - since)); }
        else if (after && !done[name]) left += expected;
      }
      return left / pace();
    }

    function state() {
      const error = status.error ? `: ${errorText(status.error)}` : "";
      byId("state").textContent = `${stateText(status.state, status.stop, status.history)}${status.stage ? `: ${word(status.stage, "stage")}` : ""}${error}`;
      byId("state").className = status.state === "stop_not_confirmed" ? "alarm" : "";
      const over = ENDED.includes(status.state);
      if (!over) wentOn = true;
      if (status.simulated) byId("simulated").hidden = false;       // a simulator on a bus is recognized in preflight
      const rests = over && !["stop_not_confirmed", "interrupted"].includes(status.state);
      if (rests && wentOn) {      // the page becomes the result, once; a shaft that may still turn keeps its Stop
        try { sessionStorage.removeItem(STARTED); } catch (error) { /* nothing was kept */ }
        location.replace(`/runs/${run}`);
        return;
      }
      byId("ended").hidden = !over;
      byId("stop").disabled = rests;
      byId("stop").closest(".stopbar").classList.toggle("past", rests);      // nothing is left to stop: only the times stay
      const confirm = status.state === "awaiting_confirmation" && status.confirmation;
      byId("confirm").hidden = !confirm;
      if (confirm) {
        checklist(status.confirmation.text);
        const marks = { ok: "✓", note: "i" }, half = status.expected_half_width, whole = Object.values(status.expected_s).reduce((sum, one) => sum + one, 0);
        byId("confirm-expected").textContent = `${half ? tr("Expected: J to {share}, about {time}.", { share: percent(half), time: span(whole) }) : tr("Expected: about {time}.", { time: span(whole) })} ${tr("{drive}; if the host fails: {action}", { drive: status.identity, action: word(status.safe_action, "reaction") })}.`;
        show(byId("confirm-checks"), ...status.preflight.map((one) => el("tr", { class: one.outcome }, el("td", {}, marks[one.outcome] || "✗"), el("th", { scope: "row" }, one.name), ...[one.wanted, one.found, one.where].map((text) => el("td", {}, byLabels(text))))));
      }
      stopTimes();
      watching();
    }

    /** Show the text of the confirmation; each "[ ]" in it is to be ticked before the shaft may be moved. */
    function checklist(text) {
      const where = byId("confirm-text"), move = byId("confirm-form").querySelector("button");
      if (where.dataset.of === text) return;             // keep what is ticked
      where.dataset.of = text;
      const boxes = [];
      const ready = () => { move.disabled = boxes.some((box) => !box.checked); };
      show(where, ...text.split("\n").flatMap((line) => {
        const found = /^\s*\[ \] (.*)$/.exec(line);
        if (!found) return [`${line}\n`];
        const box = el("input", { type: "checkbox" });
        box.addEventListener("change", ready);
        boxes.push(box);
        const meant = word(found[1], "check");         // the English text is bound to the code
        return [el("label", { class: "check" }, box, " ", english(found[1]), meant === found[1] ? "" : el("span", { class: "dim" }, ` – ${meant}`))];
      }));
      byId("confirm-tick").hidden = !boxes.length;
      ready();
    }

    function stopTimes() {
      const stop = (status && status.stop) || {}, late = tooLate && stop.at_rest && !stop.asked;
      show(byId("stop-times"), ...stopSteps(stop, Boolean(asking)), late ? el("li", {}, tr("The shaft has been at standstill since {time}.", { time: clock(stop.at_rest) })) : null);
    }

    /** The stop is not acknowledged; or the run acknowledged it, and its drive does not react. */
    function stopAlarm() {
      const stop = (status && status.stop) || {}, over = status && ENDED.includes(status.state);
      if (stop.asked || stop.at_rest || over) undelivered = "";
      const waits = stop.asked && !stop.seen && !stop.at_rest && !over && status.history.some((one) => one.state === "moving");
      unseen = waits ? unseen || Date.now() : null;
      if (saidOfRig) return;                  // the result of a stop after the run stays
      const text = undelivered || (unseen && Date.now() - unseen > SILENT_MS ? tr("NO REPLY FROM THE DRIVE: use the hard-wired emergency stop") : "");
      byId("undelivered").hidden = !text;
      if (text && byId("undelivered").textContent !== text) byId("undelivered").textContent = text;
    }

    let saidOfRig = false;

    /** Show what came of a stop of the rig's drive after the run. */
    function ofRig(...parts) {
      saidOfRig = parts.some(Boolean);
      byId("undelivered").replaceChildren(...parts);
      byId("undelivered").hidden = !saidOfRig;
    }

    byId("stop").addEventListener("click", async () => {
      if (status && ENDED.includes(status.state)) { await stopRig({ id: status.rig, name: status.rig_name || status.rig }, ofRig); return; }      // the run is over, its shaft may still turn
      asking = Date.now();
      stopTimes();
      const late = setTimeout(() => { undelivered = UNDELIVERED; stopAlarm(); }, SILENT_MS);
      try {
        const found = await call("POST", `/runs/${run}/stop`, {}, {}, 10000);
        tooLate = Boolean(found.stop.at_rest && !found.stop.asked);
        if (found.stop.asked || tooLate || found.state === "requested" || ENDED.includes(found.state)) {
          clearTimeout(late);
          undelivered = "";
        }
        if (status) {              // the socket may have newer data: a late answer must not replace them
          const stop = Object.fromEntries(Object.entries(found.stop).map(([name, value]) => [name, value ?? status.stop[name]]));
          const newer = found.history.length >= status.history.length;
          status = { ...status, stop, ...(newer ? { state: found.state, stage: found.stage, history: found.history } : {}) };
          state();
        }
      } catch (error) {
        clearTimeout(late);
        // with 504 the run's process was ended, and the message states what to check
        undelivered = !(error instanceof Refused) ? UNDELIVERED : error.status === 504 ? error.message : `${UNDELIVERED}. ${error.message}`;
      } finally {
        asking = null;
        stopTimes();
        stopAlarm();
      }
    });

    // -- the lease of a watched run: the page that confirmed it renews it while it is visible

    const heldAs = `tdhil-lease-${run}`;
    let key = null, newKey = null, renewing = false, mine = false, heard = 0;
    try { key = sessionStorage.getItem(heldAs); } catch (error) { /* then a reloaded page has lost it */ }
    mine = key !== null;
    if (key) newKey = crypto.randomUUID();       // of two pages with one key, the later one gets it
    function hold(found) {
      key = found;
      mine = true;
      try { sessionStorage.setItem(heldAs, key); } catch (error) { /* as above */ }
    }

    async function renew(gone) {
      if (!key || !status || !status.watch || status.watch.lost || ENDED.includes(status.state)) return;
      if (!gone && (renewing || document.visibilityState !== "visible")) return;
      renewing = true;
      try {
        await call("POST", `/runs/${run}/lease`, gone ? { key, gone } : { key, new_key: newKey }, {}, 1500, Boolean(gone));
        if (gone) return;
        if (newKey) { hold(newKey); newKey = null; }
        heard = Date.now();
        mine = true;
      } catch (error) {
        if (error instanceof Refused) mine = false;
      } finally {
        renewing = false;
      }
      watching();
    }

    function watching() {
      const watch = status && status.watch, where = byId("watch");
      const over = !watch || (!watch.lost && !["awaiting_confirmation", "moving"].includes(status.state));
      where.hidden = Boolean(over);
      if (over) return;
      const unheard = mine && Date.now() - heard > SILENT_MS;
      where.className = watch.lost || watch.gone || unheard ? "alarm" : "";
      const text = watch.lost ? unwatched(watch)
        : unheard ? tr("The run receives nothing from this page: it stops 5 s after the last message.")
        : mine ? tr("You watch this run. If this page is hidden or closed for 5 s, the shaft stops.")
        : watch.gone && watch.how === "silent" ? tr("{name} watches this run on another page. It has sent nothing since {time}: the run brakes 5 s after its last message.", { name: watch.by, time: clock(watch.gone) })
        : watch.gone ? tr("{name} watches this run on another page, which has been {how} since {time}: the shaft stops 5 s after that page is hidden or closed.", { name: watch.by, how: word(watch.how, "page"), time: clock(watch.gone) })
        : tr("{name} watches this run on another page: the shaft stops 5 s after that page is hidden or closed.", { name: watch.by });
      if (where.textContent !== text) where.textContent = text;
    }

    setInterval(() => renew(""), 1000);
    document.addEventListener("visibilitychange", () => renew(document.visibilityState === "visible" ? "" : "hidden"));
    addEventListener("pagehide", () => renew("closed"));

    byId("confirm-form").addEventListener("submit", async (event) => {
      event.preventDefault();
      const field = event.target.elements.code, said = byId("confirm-said");
      said.hidden = true;
      try {
        if (watched && !key) hold(crypto.randomUUID());
        await call("POST", `/runs/${run}/confirm`, { code: field.value.replace(/\s/g, ""), binding: status.confirmation.binding, lease: watched ? key : null });
      } catch (error) {
        said.textContent = whyOf(error);
        said.hidden = false;
      }
      field.value = "";
    });

    listen(run, take);

    setInterval(() => {
      const now = Date.now(), silent = message === 0 || now - message > SILENT_MS;
      const running = status && !ENDED.includes(status.state);
      const real = age === null ? null : age + (now - message) / 1000;
      const old = silent || (running && ["moving", "stopping"].includes(status.state) && real !== null && real > SILENT_MS / 1000);
      document.body.classList.toggle("stale", Boolean(old && (running || silent)));
      if (silent && message) away(status && ENDED.includes(status.state) ? tr("No answer from tdhil serve.") : `${OLD}${mine ? ` ${tr("If this page watches the run, the run brakes 5 s after its last message.")}` : ""}`);
      else if (!silent) away("");
      byId("age").textContent = real === null ? "–" : running || silent ? (real < 10 ? `${fixed(real, 1)} s` : span(real)) : tr("ended");
      stopAlarm();
      watching();
      const left = leftS();
      byId("left").textContent = left === null ? "" : `· ${tr("about {time} left", { time: span(left) })}`;
      if (status && status.confirmation && !byId("confirm").hidden) {
        const leftMs = new Date(status.confirmation.expires) - now;
        byId("confirm-left").textContent = leftMs > 0 ? tr("{count} s left", { count: Math.ceil(leftMs / 1000) }) : tr("the code is no longer valid");
      }
      if (dirty) {
        dirty = false;
        charts.set(samples);
        const last = samples[0].length - 1;
        byId("speed").textContent = last < 0 || samples[1][last] === null ? "–" : fixed(inSpeedUnit(samples[1][last]), 2);
        byId("torque").textContent = last < 0 || samples[2][last] === null ? "–" : samples[2][last].toFixed(0);
      }
    }, 150);
  }

  function auditPage() {
    let shown = "";
    every(5000, async () => {
      const found = await call("GET", "/audit"), now = JSON.stringify(found);
      if (now === shown) return;
      shown = now;
      byId("chain").className = found.broken ? "alarm" : "dim";
      byId("chain").textContent = found.broken ? tr("The chain is BROKEN at {place}: {why}", { place: `${found.broken.file}:${found.broken.line}`, why: found.broken.why }) : tr("The chain of all lines is intact. Keep its head on another computer: {head}", { head: found.head || tr("no line yet") });
      show(byId("entries"), ...found.entries.map((one) => el("tr", {}, el("th", { scope: "row" }, when(one.at)), el("td", {}, one.who), el("td", {}, one.what), el("td", {}, one.rig || ""),
        el("td", {}, one.run ? el("a", { href: `/runs/${one.run}` }, one.run) : ""), el("td", {}, Object.keys(one.details).length ? JSON.stringify(one.details) : ""))));
    });
  }

  // -- accounts

  async function saying(where, work) {
    where.hidden = true;
    try {
      await work();
    } catch (error) {
      tell(where, error);
    }
  }

  async function loginPage() {
    const next = document.body.dataset.next, form = byId("login");
    form.addEventListener("submit", (event) => {
      event.preventDefault();
      saying(byId("login-said"), async () => {
        await call("POST", "/login", { name: form.elements.name.value, password: form.elements.password.value });
        location.replace(next);
      });
    });
    const me = await call("GET", "/me");     // a link from another site has no cookie, this page's own request has it
    if (me.roles.length) location.replace(next);
  }

  async function rigFilePage() {
    const path = `/rigs/${encodeURIComponent(document.body.dataset.rig)}/file`, form = byId("rig-file"), said = byId("rig-file-said");
    let sha256 = "";
    const fill = (found) => { sha256 = found.sha256; form.elements.text.value = found.text; byId("editable").textContent = found.editable.join(", "); };
    form.addEventListener("submit", (event) => {
      event.preventDefault();
      byId("rig-file-done").textContent = "";
      saying(said, async () => { fill(await call("POST", path, { text: form.elements.text.value, sha256 })); byId("rig-file-done").textContent = tr("Saved."); });
    });
    saying(said, () => fillsFirst(form, async () => fill(await call("GET", path))));
  }

  function accountsPage() {
    const said = byId("accounts-said");
    const given = (form) => Object.fromEntries(new FormData(form));
    const sends = (id, path, after) => byId(id) && byId(id).addEventListener("submit", (event) => {
      event.preventDefault();
      const form = event.target;
      submits(form, said, async () => {
        const sent = given(form);
        after(await call("POST", path, sent));
        if (JSON.stringify(given(form)) === JSON.stringify(sent)) form.reset();       // else the next one is being typed
      });
    });
    const rows = (where, path, found) => show(byId(where), ...found.map((one) => el("tr", {}, el("th", { scope: "row" }, one.name), el("td", {}, word(one.role, "role")), el("td", {}, when(one.since)),
      el("td", {}, el("button", { type: "button", class: "quiet", "aria-label": tr("Remove {name}", { name: one.name }), onclick: () => confirm(tr("Remove {name}?", { name: one.name })) && saying(said, async () => fill(await call("POST", `/${path}/${encodeURIComponent(one.name)}/remove`, {}))) }, tr("Remove"))))));
    const fill = (found) => { rows("users", "users", found.users); rows("tokens", "tokens", found.tokens); };
    const look = async () => fill(await call("GET", "/accounts"));
    sends("password", "/password", () => location.assign("/login"));
    sends("add-user", "/users", look);
    sends("add-token", "/tokens", (made) => { show(byId("token"), `${tr("The token of {name}, shown only once:", { name: made.name })} `, el("code", {}, made.token)); look(); });
    if (byId("users")) saying(said, look);
  }

  /** The text of an error that the service sent with its page, in the language of the page. */
  function errorPage() {
    byId("reported").textContent = errorText(JSON.parse(byId("reported").dataset.error));
  }

  const logout = byId("logout");
  if (logout) logout.addEventListener("click", async () => {
    try { await call("POST", "/logout", {}); location.assign("/login"); } catch (error) { away(tr("No answer from tdhil serve: you may still be logged in.")); }
  });

  const pages = { error: errorPage, login: loginPage, accounts: accountsPage, "rig-file": rigFilePage, rigs: rigsPage, start: startPage, live: livePage, audit: auditPage };
  window.tdhil = { API, ENDED, LEAVES, STATES, Refused, asked, away, axis, badge, byId, call, closes, colour, csrf, el, eventText, every, fillsFirst, follow, inertia, inertiaNow, interval, listen, markWrong, marked, may, inSpeedUnit, number, ofResult, ofSpeed, onSpeedUnit, pacing, pages, percent, refused, rehearsal, rounded, scrolls, shareOf, show, span, speedUnit, stateText, stopSteps, submits, unmark, unwatched, uploaded, waiting, when, whyOf, zone };
  document.addEventListener("DOMContentLoaded", () => {
    speedUnits();
    document.querySelectorAll(".scroll").forEach(scrolls);
    for (const one of document.querySelectorAll("time")) one.textContent = when(one.dateTime);
    try {
      (pages[document.body.dataset.page] || (() => {}))();
    } finally {                 // until its script is ready, a page accepts neither click nor key: both would be lost
      byId("main").inert = false;
      const first = document.querySelector("[autofocus]");
      if (first) first.focus();
    }
  });
})();
