"""Pages in several languages: every text is marked, each catalogue is complete, and the API has no decimal comma."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from html.parser import HTMLParser
from pathlib import Path

import pytest
from jinja2 import Environment, nodes
from starlette.requests import Request

from tdhil.config import form_options
from tdhil.service.languages import (
    BETWEEN,
    COOKIE,
    FOLDER,
    CatalogueWrong,
    Language,
    entries,
    language,
    language_of,
    languages,
)
from tests.service.catalogue import ROOT, SCRIPTS, TEMPLATES, texts, updated
from tests.service.javascript import literals

CATALOGUES = sorted(FOLDER.glob("*.po"))
HOLE = re.compile(r"\{\w*\}")
BARE = {
    "tdhil": "name of the program", "rad/s": "unit", "rad/s²": "unit", "rad": "unit", "N·m": "unit",
    "kg·m²": "unit", "rpm": "unit",
    "PNG": "format", "CSV": "format", "SHA-256": "name of the hash", "rig.yaml": "name of a file",
    "run.mcap": "name of a file", "recovered.mcap": "name of a file", "trace.csv": "name of a file",
    "report.html": "name of a file",
    "report.pdf": "name of a file", "result.json": "name of a file", "samples.csv": "name of a file",
    "evidence.zip": "name of a file",
    "fleet.csv": "name of a file", "calibration.json": "name of a file", "A4": "size of paper",
    "bench-3": "an id, as an example", "sto@hold+2s": "a fault, as it is typed",
}
"""Texts of templates that are the same in each language, each with its reason."""
ENGLISH = {"docs.html": "the API is described in English, as in its OpenAPI document"}
"""Templates that are English in each language."""
SHOWN = ("placeholder", "aria-label", "title", "alt")
NO_TEXT = re.compile(
    r"""use strict|UTC.*|HTTP \$\{\}|GET|POST|X-CSRF-Token|Content-Type|Content Security|Idempotency-Key|TDH-\d+"""
    r"""|\(prefers-color-scheme: dark\)|tdhil \$\{\}|time_s,speed_rad_s,torque_nm|rehearsal: \$\{\}"""
    r"""|[^ ]*[/=&#\[\]_@{}][^ ]*|.*sans-serif|rotate\(.*\)|(?:[\w.]*\$\{\})+[\w.-]*|tdhil[\w-]*(\$\{\})?"""
    r"""|by hand|now alarm|verdict good""")
"""Literals of a script that are not visible, or are data: addresses, headers, classes, formats of dates."""
UNITS = re.compile(r"\$\{\}|[^\w]|N·m(·s/rad)?|kg·m²|rad|Hz|KiB|MiB|min|s\b|SHA-256|\d")
NOT_SHOWN = re.compile(
    r"(?:class|[cC]lassName|id|type|href|role|scope|kind|key|for|tag|fill|stroke|lang|textAlign|textBaseline|font|name"
    r"|rel|loading|autocomplete|autocapitalize|inputmode|label|[a-z]+Selector(?:All)?|closest|matches|sessionStorage"
    r"|localStorage|byId|addEventListener|toggle|add|remove|getContext|postMessage|createElement\w*|setAttribute)\W+"
    r"(?:[\w.]+ \? )?$")


class Shown(HTMLParser):
    """Visible texts and attributes of a page, without those of code."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []
        self._inside: list[str] = []

    def handle_starttag(self, tag, attrs):
        if tag not in ("input", "meta", "link", "br", "img"):
            self._inside.append(tag)
        self.found += [value for name, value in attrs if name in SHOWN and value]

    def handle_endtag(self, tag):
        if tag in self._inside:
            while self._inside.pop() != tag:
                pass

    def handle_data(self, data):
        if not {"code", "pre", "script"} & set(self._inside):
            self.found.append(data)


def bare(template: str) -> list[str]:
    """Return the texts of a template that are not in `_()`."""
    parser = Shown()
    template = re.sub(r"\{% block data %\}.*?\{% endblock %\}", "", template)
    parser.feed(re.sub(r"\{\{.*?\}\}|\{%.*?%\}|\{#.*?#\}", "·", template, flags=re.DOTALL))
    pieces = (piece.strip(" :,;()±.…") for text in parser.found
              for piece in re.split("[·\n]", text.replace("·m", "_m")))
    found = [one.replace("_m", "·m") for one in pieces if re.search(r"[^\W\d_]{2,}", one)]
    of_macros = [const.value for output in Environment().parse(template).find_all(nodes.Output)
                 for one in output.nodes if isinstance(one, nodes.CondExpr | nodes.Const)
                 for const in ((one.expr1, one.expr2) if isinstance(one, nodes.CondExpr) else (one,))
                 if isinstance(const, nodes.Const) and re.search(r"\w \w", str(const.value))]
    return [one for one in (*found, *of_macros) if one not in BARE]


@pytest.mark.parametrize("path", [one for one in TEMPLATES if one.name not in ENGLISH], ids=lambda path: path.name)
def test_each_text_of_a_template_is_wrapped(path):
    assert bare(path.read_text(encoding="utf-8")) == []


@pytest.mark.parametrize("path", SCRIPTS, ids=lambda path: path.name)
def test_each_text_of_a_script_is_wrapped(path):
    """A literal of two words, or of one with a capital, is a text, unless the code before it shows another use."""
    found = [(one.line, one.text) for one in literals(path.read_text(encoding="utf-8"))
             if re.search(r"[A-Za-z]{2,} |^[A-Z][a-z]+", one.text) and not one.before.endswith("tr(")
             and not NO_TEXT.fullmatch(one.text) and re.search("[A-Za-z]{2,}", UNITS.sub("", one.text))
             and not NOT_SHOWN.search(one.before)]
    assert found == []


def test_the_search_for_bare_texts_finds_them():
    assert bare('<p>Stop here {{ _("now") }}</p><input placeholder="as rig">') == ["Stop here", "as rig"]
    assert bare('<code>tdhil stop</code><p>{{ _("Stop") }}: 3 N·m {{ "in use" if x else "" }}</p>') == ["in use"]
    script = 'el("p", { class: "dim" }, "Nothing moves", `at ${f("x y")} s`); // "no text"\nx = /"/; y = tr("Stop");'
    assert [(one.text, one.template) for one in literals(script)] == [
        ("p", False), ("dim", False), ("Nothing moves", False), ("at ${} s", True), ("x y", False), ("Stop", False)]


@pytest.mark.parametrize("path", CATALOGUES, ids=lambda path: path.name)
def test_a_catalogue_has_each_text_and_no_other(path):
    """`python -m tests.service.catalogue` updates it. Translations are entered by hand."""
    text = path.read_text(encoding="utf-8")
    assert text == updated(text)
    assert [one["msgid"] for one in entries(text)[1:] if not one["msgstr"] or "fuzzy" in one.get("flags", "")] == []
    found = language(text)
    assert found.tag == path.stem and set(found.texts) == set(texts())


@pytest.mark.parametrize("path", CATALOGUES, ids=lambda path: path.name)
def test_a_translation_has_the_values_of_its_text_and_its_edges(path):
    wrong = []
    for one in entries(path.read_text(encoding="utf-8"))[1:]:
        text, made = one["msgid"], one["msgstr"]
        same = sorted(HOLE.findall(text)) == sorted(HOLE.findall(made))
        if not same or text.strip() != text or made.strip() != made or ("<" in made and "<" not in text):
            wrong.append(text)
        if text.endswith((".", "…", ":")) and not made.endswith(text[-1]):
            wrong.append(f"ends otherwise: {text}")
    assert wrong == []


def test_a_catalogue_is_read_as_gettext_writes_it():
    text = ('# by a translator\nmsgid ""\nmsgstr ""\n"Language: xx\\n"\n"X-Language-Name: Xx\\n"\n"X-Decimal: ,\\n"\n\n'
            '#: a.html\nmsgid "a \\"b\\"\\n"\n"c"\nmsgstr "é"\n\n#, fuzzy\nmsgid "old"\nmsgstr "alt"\n\n'
            'msgctxt "stage"\nmsgid "hold"\nmsgstr "halten"\n\n#~ msgid "gone"\n#~ msgstr "weg"\n\n'
            'msgid "x"\nmsgstr ""\n')
    assert language(text) == Language("xx", "Xx", ",", {'a "b"\nc': "é", f"stage{BETWEEN}hold": "halten"})
    for wrong in (text.replace('msgid "old"', "msgid old"), text.replace("X-Decimal", "X-Point")):
        with pytest.raises(CatalogueWrong):
            language(wrong)


def test_a_text_and_its_values_are_escaped():
    found = Language("xx", "Xx", ",", {"of {name}": "<b> {name} {name} {other}"})
    assert found.text("of {name}", name="<i>") == "&lt;b&gt; &lt;i&gt; &lt;i&gt; {other}"
    assert (found.number(0.25), found.number(400.0), found.word("hold", "stage")) == ("0,25", "400", "hold")


@pytest.mark.parametrize(("accepted", "cookie", "chosen"), [
    ("", "", "en"), ("de-DE,de;q=0.9,en;q=0.8", "", "de"), ("en-US,en;q=0.9,de;q=0.8", "", "en"),
    ("fr, de;q=0.5", "", "de"), ("fr", "", "en"), ("de;q=0, en", "", "en"), ("de;q=x", "", "en"),
    ("de", "en", "en"), ("en", "de", "de"), ("en", "../xx", "en"), (f"{'x,' * 9999}de", "", "en"),
])
def test_the_language_is_that_of_the_cookie_then_of_the_browser_then_english(accepted, cookie, chosen):
    headers = [(b"accept-language", accepted.encode()), (b"cookie", f"{COOKIE}={cookie}".encode())]
    request = Request({"type": "http", "headers": headers})
    assert language_of(request, languages()) == chosen


def test_a_page_has_the_language_of_its_reader(client):
    german = {"accept-language": "de"}
    page = client.get("/start/a", headers=german)
    assert '<html lang="de">' in page.text and "Lauf starten: Rig a" in page.text
    assert page.headers["vary"] == "Accept-Language, Cookie"
    assert '<html lang="en">' in client.get("/start/a").text
    assert "0,5 s ohne Nachricht" in page.text and "0.5 s of silence" in client.get("/start/a").text
    script = client.get("/texts/de.js")
    assert script.headers["content-type"].startswith("text/javascript") and script.text.isascii()
    assert client.get("/texts/xx.js").status_code == client.get("/texts/..%2Fde.js").status_code == 404


def test_a_machine_gets_the_same_bytes_in_each_language(client, service):
    """Every document of the API is the same, errors included. Only pages have a language."""
    run = service.supervisor.start_run("a", {"note": "done"}, "local").request.id
    service.wait(run, "done")
    service.supervisor.close()
    paths = ("rigs", "rigs/a", "rigs/nothing", "runs", f"runs/{run}", f"runs/{run}/result.json", "me", "accounts",
             "fleets", "fleets/folders", "new-rig", "openapi.json", "runs?limit=x", "audit", "uploads", "nothing")
    for path in paths:
        found = [client.get(f"/api/v1/{path}", headers={"accept-language": one, "cookie": f"{COOKIE}={one}"})
                 for one in ("en", "de")]
        assert found[0].content == found[1].content and found[0].status_code == found[1].status_code, path
    sent = [client.post("/api/v1/rigs/a/plan", json={"tolerance": "lots"}, headers={"accept-language": one})
            for one in ("en", "de")]
    assert sent[0].status_code == 422 and sent[0].content == sent[1].content


SCRIPT = """
const vm = require("node:vm"), fs = require("node:fs");
const [language, texts, calls] = JSON.parse(fs.readFileSync(0, "utf-8"));
const document = {
  documentElement: { lang: language }, addEventListener() {}, createElement: () => ({}), querySelector: () => null,
};
const window = {};
vm.runInNewContext(texts, { window });
vm.runInNewContext(fs.readFileSync(process.argv[1], "utf-8"), { window, document, Intl });
console.log(JSON.stringify(calls.map(([name, ...given]) => window.tdhilLanguage[name](...given))));
"""


def in_script(tag: str, *calls: list[object]) -> list[object]:
    """Return the results of functions of texts.js, called in node."""
    text = json.dumps([tag, languages()[tag].script(), calls])
    done = subprocess.run(["node", "-e", SCRIPT, str(ROOT / "tdhil/service/static/texts.js")], input=text, text=True,
                          capture_output=True, timeout=600, check=True)
    found: list[object] = json.loads(done.stdout)
    return found


@pytest.mark.heavy
def test_numbers_of_a_script_are_shown_in_the_language_and_sent_with_a_point():
    if shutil.which("node") is None:
        pytest.skip("no node: tests/service/chromium/test_german.py shows the same in Chromium")
    calls = [["fixed", 1234.5, 2], ["precise", 0.00001234, 2], ["local", "-1.5e-7"], ["tick", 1234.5],
             ["point", "0,5"], ["point", " -2,5 kN·m"], ["point", "1.5"], ["point", "1.000,5"], ["point", "eth1,2"],
             ["fixed", -0.00004, 3]]
    assert in_script("en", *calls) == ["1234.50", "0.000012", "-1.5e-7", "1234.5",
                                       "0.5", "-2.5 kN·m", "1.5", "1.000,5", "eth1,2", "0.000"]
    assert in_script("de", *calls) == ["1234,50", "0,000012", "-1,5e-7", "1234,5",
                                       "0.5", "-2.5 kN·m", "1.5", "1.000,5", "eth1,2", "0,000"]
    error = {"what": "operator does not have the role admin", "where": "audit", "message": "x", "code": "TDH-413",
             "next_step": "Ask an engineer"}
    unknown = {"what": "7 moles", "where": "", "message": "7 moles", "code": "TDH-412", "next_step": ""}
    assert in_script("de", ["errorText", error], ["errorText", unknown], ["word", "constructor"], ["tr", "Stop"]) == [
        "audit: Bediener hat nicht die Rolle Verwalter. Fragen Sie einen Ingenieur",
        "Die Welle dreht schon vor dem Lauf. (TDH-412: 7 moles)", "constructor", "Stopp"]


def test_each_option_of_a_form_is_named_in_each_language():
    for one in languages().values():
        for part in ("run", "acquire", "simulated", "real", "replay", "trace", "upload"):
            for option in form_options(part):
                assert option.form is not None
                assert one.tag == "en" or option.form.label in one.texts


def test_the_catalogues_are_in_the_folder_that_the_wheel_contains():
    assert Path(FOLDER).is_dir() and [one.stem for one in CATALOGUES] == ["de"]
