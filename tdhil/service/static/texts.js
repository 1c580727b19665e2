// Texts and numbers of the pages in the reader's language. A text of a page is its own English translation.
"use strict";
(() => {
  const LANGUAGE = document.documentElement.lang, BETWEEN = "\u0004", MESSAGE = `message${BETWEEN}`;
  const LEAST = 6;             // fixed signs of a message with values: with fewer it would fit any text
  const texts = new Map(Object.entries(window.tdhilTexts || {})), titles = new Map(Object.entries(window.tdhilTitles || {})), labels = new Map(Object.entries(window.tdhilLabels || {}));
  const HOLE = /\{(\w+)\}/g;
  const fill = (text, values) => text.replace(HOLE, (hole, name) => (name in values ? values[name] : hole));

  /** Translate a text that stands here as it is; each {name} becomes its value. */
  const tr = (text, values = {}) => fill(texts.get(text) ?? text, values);
  /** Translate a word that the service sends, as a state or a label. An unknown one stays English. */
  const word = (text, context = "") => texts.get(context ? `${context}${BETWEEN}${text}` : text) ?? text;

  /** A value in a message may be a word of the vocabulary. */
  const value = (text) => ["role", "state", "verdict", "reaction"].map((context) => texts.get(context + BETWEEN + text)).find(Boolean) ?? (text.includes(" ") ? phrase(text) : null) ?? text;

  const COMMAND_OR_FLAG = /(tdhil [a-z]+(?: [a-z-]+)?(?: [\w-]+\.\w+)*(?: --[a-z][a-z-]*(?: [A-Z\d][\w.-]*| [\w-]+\.\w+)?)+)|(^|[^\w-])(--?[a-z][a-z-]*)(?![\w-])/g;
  /** Replace each option of the command line by what the pages call it: the label of this page's field, else what `Language.labels` has. A whole command is for a terminal, and stays. */
  function byLabels(text) {
    const label = (flag) => {
      const field = document.querySelector(`[data-flag="${flag}"]`);
      return field ? `“${field.dataset.label}”` : labels.get(flag) ?? flag;
    };
    return text.replace(COMMAND_OR_FLAG, (found, command, before, flag) => (command ? found : before + label(flag)));
  }

  const SHORT = 10;            // fixed signs of a message whose values are single words: "must be {0}" would fit any sentence
  let patterns = null;
  /** Translate a message of the service, with the values in it; null if it is not known. */
  function phrase(text) {
    const exact = texts.get(MESSAGE + text);
    if (exact || !text) return exact ?? null;
    patterns ||= [...texts].filter(([key]) => key.startsWith(MESSAGE) && key.search(HOLE) > 0).map(([key, made]) => {
      const pieces = key.slice(MESSAGE.length).split(/\{\w+\}/);
      return { fixed: pieces.join("").length, made, fits: new RegExp(`^${pieces.map((one) => one.replace(/[.*+?^${}()|[\]\\/]/g, "\\$&")).join("(.*?)")}$`, "s") };
    }).filter((one) => one.fixed >= LEAST).sort((a, b) => b.fixed - a.fixed);
    for (const { fixed, fits, made } of patterns) {
      const found = fits.exec(text);
      if (found && (fixed >= SHORT || found.slice(1).every((one) => !one.includes(" ")))) return fill(made, { ...found.slice(1).map(value) });
    }
    return null;
  }
  function errorIn(error) {
    if (!texts.size) return error.message;
    const what = phrase(error.what || error.message), next = error.next_step ? phrase(error.next_step) ?? error.next_step : "";
    if (what) return `${error.where ? `${error.where}: ` : ""}${what}${next ? `. ${next}` : ""}`;
    return titles.has(error.code) ? `${titles.get(error.code)}. (${error.code}: ${error.message})` : error.message;
  }
  /** The text of an error: translated, or the title of its code with the English message behind it. */
  const errorText = (error) => byLabels(errorIn(error));
  /** A text that the service composes in English, marked as English on a page of another language. */
  function english(text) {
    if (!text) return text;
    if (!texts.size) return byLabels(text);
    const found = document.createElement("span");
    found.lang = "en";
    found.textContent = byLabels(text);
    return found;
  }
  /** A message of the service as an element or a text: translated if it is known, else in English. */
  function worded(text) {
    const known = phrase(text);
    return known === null ? english(text) : byLabels(known);
  }
  /** A text of a result with its code: on a page of another language, the title of the code stands before it. */
  const coded = (code, text) => (texts.size && titles.has(code) ? [`${titles.get(code)}. `, english(text)] : [english(text)]);

  const POINT = new Intl.NumberFormat(LANGUAGE).formatToParts(1.5).find((one) => one.type === "decimal").value;
  /** A formatted number with the decimal sign of the language. Thousands are never grouped: 1.000 would be read as 1. */
  const local = (text) => (POINT === "." ? text : text.replace(/(\d)\.(?=\d)/g, `$1${POINT}`));
  const fixed = (value, places) => local((Number(value.toFixed(places)) + 0).toFixed(places));      // + 0: no −0
  const precise = (value, digits) => local(value.toPrecision(digits));
  const ticks = new Intl.NumberFormat(LANGUAGE, { useGrouping: false, maximumSignificantDigits: 8 });
  const tick = (value) => (value === null ? "" : ticks.format(value));
  /** A typed number with a point, as the service reads it. A comma is accepted in every language. */
  const point = (typed) => typed.trim().replace(/^([-+]?\d*),(?=\d)/, "$1.");

  document.addEventListener("DOMContentLoaded", () => {
    for (const one of document.querySelectorAll("[data-flags]")) one.textContent = byLabels(one.textContent);
    for (const one of document.querySelectorAll("[data-language]")) one.addEventListener("click", () => {
      document.cookie = `tdhil-language=${one.dataset.language}; path=/; max-age=31536000; samesite=lax`;
      location.reload();
    });
  });
  window.tdhilLanguage = { byLabels, coded, english, errorText, fixed, local, point, precise, tick, tr, word, worded };
})();
