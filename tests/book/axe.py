"""axe-core's rules on an open page, with the colours of each kind of text looked at once.

axe works for seconds on the contrast of each of the thousands of words of highlighted code, though they come in a few dozen
colours. So all other rules run on the whole page, and the one on contrast on one text of each kind (distinct.js says which are
alike); where axe cannot tell for that one, all of its kind are looked at.
"""

from __future__ import annotations

from pathlib import Path

from axe_playwright_python.base import AXE_SCRIPT

DISTINCT = Path(__file__).with_name("distinct.js").read_text(encoding="utf-8")
MARK = "one-of-its-kind"
COLOURS = ["color-contrast", "link-in-text-block"]  # axe's rules on colours, of those that run unless they are asked for
ONCE = """async ([mark, only]) => {
  const marked = `[xmlns="${mark}"]`, unmark = (node) => node.removeAttribute("xmlns");
  const run = (options) => axe.run({...options, elementRef: true, resultTypes: ["violations", "incomplete"]});
  const untold = (results) => results.incomplete.filter((one) => one.id === "color-contrast");
  const uneven = (node) => node.any.some((check) => ["bgGradient", "bgImage"].includes(check.data?.messageKey));
  axe.configure({rules: [{id: "color-contrast", selector: marked}]});
  const runs = [await run(only ? {runOnly: only} : {})];
  const kinds = new Map([...alike.values()].map((kind) => [kind[0], kind]));
  const others = untold(runs[0]).flatMap((one) => one.nodes).flatMap((node) => kinds.get(node.element)?.slice(1) ?? []);
  document.querySelectorAll(marked).forEach(unmark);
  others.forEach((one) => one.setAttribute("xmlns", mark));
  if (others.length) runs.push(await run({runOnly: ["color-contrast"]}));
  others.forEach(unmark);
  const found = runs.flatMap((results) => [
    ...results.violations,
    ...untold(results).map((one) => ({...one, nodes: one.nodes.filter(uneven)})).filter((one) => one.nodes.length),
  ]);
  return found.map(({id, impact, nodes}) => ({id, impact, nodes: nodes.map(({element, target, failureSummary}) => {
    const more = id === "color-contrast" ? (kinds.get(element)?.length ?? 1) - 1 : 0;
    return {target, failureSummary: failureSummary + (more ? `\\n  and ${more} more of its kind` : "")};
  })}));
}"""
EVERYWHERE = "axe.reset(), axe.run({resultTypes: ['violations']}).then((found) => found.violations)"


def violations(page, colours_only: bool = False) -> list[dict]:
    """The rules that the page breaks: {id, impact, nodes: [{target, failureSummary}]}."""
    page.evaluate(AXE_SCRIPT)
    page.evaluate(DISTINCT, MARK)
    return page.evaluate(ONCE, [MARK, COLOURS if colours_only else None])


def violations_everywhere(page) -> list[dict]:
    """The same from axe on each element, which takes ten times as long: what `violations` is tested against."""
    page.evaluate(AXE_SCRIPT)
    return page.evaluate(EVERYWHERE)


def grave(found: list[dict]) -> list[str]:
    """A line for each place at which a serious or critical rule is broken."""
    return [
        f"{one['id']}: {node['target']} {node['failureSummary']}"
        for one in found
        if one["impact"] in ("serious", "critical")
        for node in one["nodes"]
    ]
