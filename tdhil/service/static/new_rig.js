// A new rig in six steps: profile, address with a scan, settings by hand, machine limits with their picture, check, save.
"use strict";
(() => {
  const { byLabels, english, local, point, tr, word, worded } = window.tdhilLanguage;
  const { byId, call, closes, el, inSpeedUnit, markWrong, onSpeedUnit, pages, show, speedUnit, unmark, waiting, whyOf } = window.tdhil;
  const SCAN_MS = 130000;            // the service ends a scan after 120 s
  const KEPT = "tdhil-new-rig";      // what was typed, until the rig is saved or the tab is closed

  /** Picture of the limits: the window in which speed and torque stay, and the torque of the first motion. */
  function windowPicture(limits) {
    const { speed_min_rad_s: low, speed_max_rad_s: high, torque_nm: torque, probe_torque_nm: probe, quick_stop_rad_s2: brake } = limits;
    const W = 420, H = 200, left = 60, top = 14, right = 14, bottom = 44;
    const from = Math.min(0, low), x = (speed) => left + (W - left - right) * (speed - from) / (high * 1.1 - from);
    const y = (nm) => top + (H - top - bottom) * (1 - (nm + 1.15 * torque) / (2.3 * torque));
    const NS = "http://www.w3.org/2000/svg";
    const draw = (tag, attributes, text) => {
      const one = document.createElementNS(NS, tag);
      for (const [name, value] of Object.entries(attributes)) one.setAttribute(name, value);
      if (text !== undefined) one.textContent = text;
      return one;
    };
    const speed = (value) => round(inSpeedUnit(value)), round = (value) => local(Number(value.toPrecision(3)).toString());
    const svg = draw("svg", { viewBox: `0 0 ${W} ${H}`, class: "window", role: "img", "aria-label": tr("Window of motion: {low} to {high} {unit}, at most {torque} N·m either way", { low: speed(low), high: speed(high), unit: speedUnit(), torque: round(torque) }) });
    svg.append(
      draw("rect", { x: x(low), y: y(torque), width: x(high) - x(low), height: y(-torque) - y(torque), class: "inside" }),
      draw("line", { x1: left, x2: W - right, y1: y(0), y2: y(0), class: "axis" }),
      draw("line", { x1: x(0), x2: x(0), y1: top, y2: H - bottom, class: "axis" }),
      draw("line", { x1: x(0), x2: x(0), y1: y(Math.min(probe, torque)), y2: y(0), class: "probe" }));
    for (const nm of [torque, 0, -torque]) svg.append(draw("text", { x: left - 6, y: y(nm) + 4, "text-anchor": "end" }, round(nm)));
    for (const end of [low, high]) svg.append(draw("text", { x: x(end), y: H - bottom + 16, "text-anchor": "middle" }, speed(end)));
    svg.append(draw("text", { x: (left + W - right) / 2, y: H - 8, "text-anchor": "middle" }, tr("speed, {unit}", { unit: speedUnit() })),
      draw("text", { x: 14, y: (top + H - bottom) / 2, "text-anchor": "middle", transform: `rotate(-90 14 ${(top + H - bottom) / 2})` }, tr("torque, N·m")));
    return el("figure", {}, svg, el("figcaption", { class: "dim" },
      tr("Shaded: the window of a run. Thick: the sign probe, the first motion, with at most {torque} N·m. A stop from the highest speed takes {time} s.", { torque: round(probe), time: round(high / brake) })));
  }

  async function newRigPage() {
    const form = byId("new-rig");
    if (!form) return;
    const said = byId("new-rig-said"), field = (name) => form.elements[name];
    field("name").addEventListener("input", () => {
      if (!field("id").dataset.typed) field("id").value = field("name").value.trim().toLowerCase().normalize("NFKD").replace(/\p{M}/gu, "").replaceAll("ß", "ss").replace(/[^a-z0-9_.]+/g, "-").replace(/^[^a-z0-9]+|-+$/g, "").slice(0, 64);
    });
    field("id").addEventListener("input", () => { field("id").dataset.typed = "by hand"; });
    const opens = closes(form.querySelectorAll("button"));      // the Enter key would send the form before its script is ready
    let loaded = null;
    try {
      loaded = await call("GET", "/new-rig");
    } catch (error) {
      said.textContent = whyOf(error);
      said.hidden = false;
      return;
    }
    const { machine, profiles } = loaded;
    const byName = new Map(profiles.map((one) => [one.name, one]));
    const input = (name, label, placeholder = "") => el("label", { "data-field": name }, label, el("input", { name, placeholder, autocomplete: "off", autocapitalize: "none", spellcheck: "false" }));

    const capital = (text) => `${text.charAt(0).toUpperCase()}${text.slice(1)}`;
    /** Label of a key of the machine: "N·m; highest torque" is "Highest torque, N·m". */
    const meaning = ({ description: said }, description = word(said)) => (description.includes("; ") ? capital(`${description.split("; ").slice(1).join("; ")}, ${description.split("; ")[0]}`) : capital(description));
    const place = (one) => capital(`${word(one.name.replaceAll("_", " "), "key")}: ${word(one.description)}`);
    const buses = [...new Set(profiles.map((one) => one.bus_title))];
    show(field("profile"), ...buses.map((bus) => el("optgroup", { label: bus, lang: "en" }, ...profiles.filter((one) => one.bus_title === bus)
      .map((one) => el("option", { value: one.name }, `${one.title} (${one.name})`)))));
    show(byId("machine"), ...machine.map((one) => input(one.name, meaning(one))));

    const chosen = () => byName.get(field("profile").value);
    function profileChanged() {
      const one = chosen();
      show(byId("address"), ...one.address.map((key) => input(`address.${key.name}`, place(key))));
      show(byId("parameters"), ...one.parameters.map((key) => input(key.name, tr("{quantity}, as read at the drive", { quantity: word(key.description) }) + (key.unit && `, ${key.unit}`), key.required && tr("required: {value}", { value: key.required }))));
      byId("profile-hint").textContent = one.experimental ? tr("This profile was made from documents. No run with it has been reported yet.") : "";
      const doubts = Object.entries(one.unverified);
      show(byId("by-hand"),
        one.by_hand.length ? el("p", {}, tr("Make these settings at the drive, and tick each one. A run is refused if the drive does not report them:")) : el("p", {}, tr("This profile asks for no settings by hand.")),
        ...one.by_hand.map((text) => el("label", { class: "check" }, el("input", { type: "checkbox", name: "made", value: text }), english(text))),
        doubts.length ? el("p", { "data-field": "accept_unverified" }, tr("These entries of the profile are not verified on a drive. Compare each with the drive's manual. Accept it only if both agree:")) : null,
        ...doubts.map(([name, source]) => el("label", { class: "check" }, el("input", { type: "checkbox", name: "accept", value: name }), english(`${name}: ${source}`))));
    }
    function loadChanged() {
      const string = field("load").value === "string";
      for (const one of byId("machine").children) if (!one.dataset.field.startsWith("limits.")) one.hidden = !string;
    }
    function simulatedChanged() {
      const simulated = field("simulated").checked;
      for (const one of form.querySelectorAll("[data-real]")) one.hidden = simulated;
      byId("limits-hint").hidden = !simulated;
      byId("rated").hidden = simulated || !chosen().rated_torque_by_hand;
    }
    field("profile").addEventListener("change", () => { profileChanged(); simulatedChanged(); });
    field("simulated").addEventListener("change", simulatedChanged);
    field("load").addEventListener("change", loadChanged);
    field("profile").value = byName.has("generic/cia402") ? "generic/cia402" : profiles[0].name;
    profileChanged();
    loadChanged();
    simulatedChanged();

    const fields = () => [...form.elements].filter((one) => one.name && !["BUTTON", "TEXTAREA"].includes(one.tagName));
    const keyOf = (one) => (["accept", "made"].includes(one.name) ? `${one.name}:${one.value}` : one.name);
    /** Put back what was typed before the page was loaded again. A field with a newer text keeps it. */
    function putBack(kept) {
      if (byName.has(kept.profile)) { field("profile").value = kept.profile; profileChanged(); }
      for (const one of fields()) {
        const was = kept[keyOf(one)];
        if (one.type === "checkbox") one.checked ||= was === true;
        else if (one.tagName === "SELECT" ? [...one.options].some((each) => each.value === was) : was && !one.value) one.value = was;
      }
      loadChanged();
      simulatedChanged();
    }
    try { putBack(JSON.parse(sessionStorage.getItem(KEPT)) || {}); } catch (error) { /* nothing was kept */ }
    const keep = () => {
      try { sessionStorage.setItem(KEPT, JSON.stringify(Object.fromEntries(fields().map((one) => [keyOf(one), one.type === "checkbox" ? one.checked : one.value])))); } catch (error) { /* then it is lost by a reload */ }
    };
    form.addEventListener("input", keep);
    opens();

    function draft() {
      const found = { address: {}, limits: {}, string: {}, accept_unverified: [...form.querySelectorAll("[name=accept]:checked")].map((one) => one.value), alone: field("alone").checked, simulated: field("simulated").checked };
      for (const name of ["profile", "name", "load", "gear_ratio", "motion"]) found[name] = point(field(name).value);
      found.rated_torque_nm = byId("rated").hidden ? "" : point(field("rated_torque_nm").value);
      found.parameters = Object.fromEntries([...form.querySelectorAll("#parameters input")].map((one) => [one.name.replace("parameters.", ""), point(one.value)]));
      for (const one of form.querySelectorAll("#address input")) found.address[one.name.replace("address.", "")] = one.value.trim();
      for (const one of byId("machine").querySelectorAll("input")) {
        if (one.name.startsWith("limits.")) found.limits[one.name.replace("limits.", "")] = point(one.value);
        else found.string[one.name] = point(one.value);
      }
      return found;
    }
    /** Mark each mistake at its field. Return those that belong to no field. */
    function mark(problems) {
      const first = (form.querySelector("#address input") || {}).name, rest = [];
      const named = problems.map((one) => ({ option: one.field === "address" ? first : one.field, message: one.message }));
      const marked = markWrong(form, named);
      for (const one of named.filter((each) => !form.elements[each.option])) {
        const place = form.querySelector(`[data-field="${CSS.escape(one.option)}"]`);
        if (!place) { rest.push(byLabels(one.message)); continue; }
        place.append(el("span", { class: "alarm wrong" }, worded(one.message)));
        if (!marked) place.scrollIntoView({ block: "center" });
      }
      return rest;
    }
    let drawn = {};
    const picture = (limits) => { drawn = limits; show(byId("window"), Object.keys(limits).length ? windowPicture(limits) : null); };
    onSpeedUnit(() => picture(drawn));
    async function check() {
      unmark(form);
      said.hidden = true;
      const found = await call("POST", "/new-rig/draft", draft());
      picture(found.limits);
      show(byId("draft"),
        el("p", { class: found.problems.length ? "alarm" : "verdict good" }, found.problems.length ? found.problems.length === 1 ? tr("1 entry needs a correction. Each is marked at its field.") : tr("{count} entries need a correction. Each is marked at its field.", { count: found.problems.length }) : tr("The file is complete.")),
        el("label", {}, "rig.yaml", el("textarea", { name: "text", rows: "24", readonly: "", spellcheck: "false" }, found.text)));
      const rest = mark(found.problems);
      if (rest.length) { said.textContent = rest.join(" "); said.hidden = false; }
      return found;
    }
    /** Mark the fields that an error names, or show the error in this place. */
    function refused(error, where = said) {
      const fields = error.fields || [];
      if (fields.length && !mark(fields.map((one) => ({ field: one.option, message: one.message }))).length) return;
      where.textContent = whyOf(error);
      where.hidden = false;
    }
    form.addEventListener("submit", async (event) => {
      event.preventDefault();
      const save = event.submitter && event.submitter.value === "save";
      try {
        const found = await check();
        if (!save || found.problems.length) return;
        const made = await call("POST", "/rigs", { id: field("id").value.trim(), text: found.text });
        try { sessionStorage.removeItem(KEPT); } catch (error) { /* nothing was kept */ }
        location.assign(`/start/${encodeURIComponent(made.id)}${made.simulated ? "" : "?first=true"}`);
      } catch (error) {
        refused(error);
      }
    });
    byId("machine").addEventListener("change", async () => {          // the picture alone: a mistake is marked by Check
      try { picture((await call("POST", "/new-rig/draft", draft())).limits); } catch (error) { refused(error); }
    });
    byId("scan").addEventListener("click", async () => {
      unmark(form);
      said.hidden = true;
      const over = waiting(byId("scan-said"), tr("Scanning"));
      byId("scan").disabled = true;
      try {
        const { found, remarks } = await call("POST", "/new-rig/scan", draft(), {}, SCAN_MS);
        over();
        show(byId("scan-said"), ...found.map((one) => el("article", { class: "card" },
          el("p", {}, el("strong", {}, one.title || tr("a drive without a name")), ` · ${one.identity}${one.simulated ? ` · ${tr("SIMULATED")}` : ""}`),
          el("p", {}, Object.entries(one.fields).map(([name, text]) => `${word(name.replaceAll("_", " "), "key")} ${text}`).join(", ")),
          el("p", { class: "dim" }, tr("profile {profile} ({why})", { profile: one.profile || tr("none"), why: one.why })),
          el("button", { type: "button", class: "quiet", onclick: (event) => {
            if (!event.target.nextElementSibling) event.target.after(" ", el("span", { class: "dim", role: "status" }, tr("The fields above now have its address.")));
            if (one.profile && byName.has(one.profile) && one.profile !== field("profile").value) {
              const typed = draft().address;
              field("profile").value = one.profile;
              profileChanged();
              for (const [name, text] of Object.entries(typed)) if (field(`address.${name}`)) field(`address.${name}`).value = text;
            }
            for (const [name, text] of Object.entries(one.fields)) if (field(`address.${name}`)) field(`address.${name}`).value = text;
          } }, tr("Use this drive")))),
          found.length ? null : el("p", {}, tr("No drive replied.")), ...remarks.map((text) => el("p", { class: "dim" }, english(text))));
      } catch (error) {
        over();
        const alarm = el("p", { class: "alarm", hidden: true });
        show(byId("scan-said"), alarm);
        refused(error, alarm);
      } finally {
        byId("scan").disabled = false;
      }
    });
  }
  pages["new-rig"] = newRigPage;
})();
