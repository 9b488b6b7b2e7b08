// The tabs beside the map, and the panes that they show.
import { byId, element } from "./dom.js";
import { words } from "./words.js";

/** @returns {HTMLElement[]} */
const tabs = () => [...document.querySelectorAll("[role=tab]")].map((tab) => /** @type {HTMLElement} */ (tab));

/** Choose a tab, and show its pane. */
export function showTab(tab) {
  for (const each of tabs()) {
    const chosen = each === tab;
    each.setAttribute("aria-selected", String(chosen));
    each.tabIndex = chosen ? 0 : -1;
    if (chosen) each.scrollIntoView({ block: "nearest", inline: "nearest" });
    const pane = byId(each.getAttribute("aria-controls"));
    pane.hidden = !chosen;
    if (chosen) pane.scrollIntoView({ block: "nearest" });
  }
}

function watch(tab) {
  tab.onclick = () => showTab(tab);
  tab.onkeydown = (event) => {
    const by = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
    if (!by) return;
    const shown = tabs().filter((each) => !each.hidden);
    const next = shown[(shown.indexOf(tab) + by + shown.length) % shown.length];
    showTab(next);
    next.focus();
  };
}

/** Let the tabs of index.html show their panes. */
export function watchTabs() {
  tabs().forEach(watch);
}

/**
 * Add a pane behind the others; the string `tab.NAME` is the text of its tab.
 *
 * @param {string} name
 * @param {...(Node | string)} children
 * @returns {{tab: HTMLElement, pane: HTMLElement}} hide the tab while there is nothing to show
 */
export function addPane(name, ...children) {
  const tab = element("button", { id: `tab-${name}`, tabIndex: -1, textContent: words(`tab.${name}`) });
  const pane = element("section", { id: `pane-${name}`, tabIndex: 0, hidden: true }, ...children);
  for (const [key, value] of [["role", "tab"], ["aria-controls", pane.id], ["aria-selected", "false"]]) tab.setAttribute(key, value);
  for (const [key, value] of [["role", "tabpanel"], ["aria-labelledby", tab.id]]) pane.setAttribute(key, value);
  const list = byId("tabs");
  list.append(tab);
  list.parentElement.append(pane);
  watch(tab);
  return { tab, pane };
}
