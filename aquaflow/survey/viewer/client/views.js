// The views that are kept with a finished dive: their names, each of which leads there.

import { tell } from "./load.js";

const made = (kind, properties) => Object.assign(document.createElement(kind), properties);

// In `place`; `link` is the address of the view at the moment, `failed(sentence)` is told what went wrong.
export async function showViews(place, link, failed) {
  const guarded = async work => { try { await work(); failed(""); } catch (error) { failed(error.message); } };
  const list = made("ul", { className: "kept" }), form = made("form"), name = made("input", { maxLength: 100, placeholder: "Name of this view" });
  name.setAttribute("aria-label", name.placeholder);
  form.append(name, made("button", { textContent: "Keep" }));
  place.replaceChildren(form, list);
  form.addEventListener("submit", event => {
    event.preventDefault();
    guarded(async () => {
      await tell("viewpoints/add", { name: name.value, link: link.words });
      name.value = "";
      await show();
    });
  });
  const show = async () => {
    const { viewpoints } = await tell("viewpoints/list", {});
    list.replaceChildren(...viewpoints.map(view => {
      const row = made("li"), remove = made("button", { textContent: "Remove" });
      const leads = made("a", { href: `#${view.link}`, textContent: view.name });
      leads.addEventListener("click", event => { event.preventDefault(); link.go(view.link); });
      row.append(leads, remove);
      remove.addEventListener("click", () => guarded(async () => { await tell("viewpoints/remove", { key: view.key }); await show(); }));
      return row;
    }));
  };
  await guarded(show);
}
