// The head of the reports: company, address, logo.
"use strict";
(() => {
  const { tr } = window.tdhilLanguage;
  const { Refused, byId, call, el, fillsFirst, pages, show, submits } = window.tdhil;

  /** The file in base64, without the beginning of a data URL. */
  const inBase64 = (file) => new Promise((done, fail) => {
    const reader = new FileReader();
    reader.addEventListener("load", () => done(reader.result.slice(reader.result.indexOf(",") + 1)));
    reader.addEventListener("error", () => fail(new Refused(tr("The file can't be read."))));
    reader.readAsDataURL(file);
  });

  function letterheadPage() {
    const form = byId("letterhead"), said = byId("letterhead-said"), logo = byId("logo"), done = byId("letterhead-done");
    const fields = form.elements;
    function fill(found) {
      fields.company.value = found.company;
      fields.address.value = found.address.join("\n");
      fields.logo.value = "";
      fields.remove.checked = false;
      logo.hidden = !found.logo;
      if (found.logo) logo.querySelector("img").src = `data:image/png;base64,${found.logo}`;
    }
    form.addEventListener("submit", (event) => {
      event.preventDefault();
      show(done);
      submits(form, said, async () => {
        const chosen = fields.logo.files[0];
        const picture = chosen ? await inBase64(chosen) : fields.remove.checked ? "" : null;
        fill(await call("POST", "/letterhead", { company: fields.company.value, address: fields.address.value.split("\n"), logo: picture }));
        show(done, el("span", { class: "dim" }, tr("Saved. Each report is made again when it is next opened.")));
      });
    });
    submits(form, said, () => fillsFirst(form, async () => fill(await call("GET", "/letterhead"))));
  }

  pages.letterhead = letterheadPage;
})();
