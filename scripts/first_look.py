"""How much a visitor meets at first sight: controls, words and font sizes in the window, and where the first figure begins.

    python scripts/first_look.py [--save FOLDER]

Starts `wfsobs serve` and a headless Chromium (as measure_dashboard.py) and waits until the run is done. A control
takes the focus, by Tab or by the arrow keys of its group; a word is text between blanks, outside of a canvas; either counts where
a part of it is visible in the window, not scrolled or clipped away. Figure: the distance of the first one from the window's top.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from measure_dashboard import BROWSER, FLAGS, _server
from playwright.sync_api import sync_playwright

SIZES = {"wide": (1440, 900), "laptop": (1280, 720), "phone": (390, 844)}

COUNT = """() => {
  const inside = (el) => {  // the part of an element that no ancestor clips away; null where there is none
    let {left, top, right, bottom} = el.getBoundingClientRect()
    for (let at = el; at; at = at.assignedSlot ?? at.parentElement ?? at.getRootNode().host) {
      if (at !== el && getComputedStyle(at).overflow !== "visible") {
        const box = at.getBoundingClientRect()
        left = Math.max(left, box.left); right = Math.min(right, box.right)
        top = Math.max(top, box.top); bottom = Math.min(bottom, box.bottom)
      }
    }
    left = Math.max(left, 0); right = Math.min(right, innerWidth); top = Math.max(top, 0); bottom = Math.min(bottom, innerHeight)
    return right - left > 1 && bottom - top > 1 ? {left, top, right, bottom} : null
  }
  const shown = (el) => el.checkVisibility({opacityProperty: true, visibilityProperty: true}) && inside(el)
  const controls = [], words = [], sizes = {}
  let figure = null
  const look = (root) => {
    for (const el of root.querySelectorAll("*")) {
      if (!el.disabled && !el.closest("[inert], dialog:not([open])") && shown(el)
          && el.matches("a[href], button, input, select, textarea, summary, [role=button], [role=slider], [tabindex='0']")) {
        controls.push((el.getAttribute("aria-label") ?? el.title ?? "") || el.textContent.trim().slice(0, 40) || el.localName)
      }
      if (el.localName === "canvas" && el.getBoundingClientRect().height > 100) {
        const top = el.getBoundingClientRect().top
        figure = figure === null ? top : Math.min(figure, top)
      }
      for (const node of el.childNodes) {
        if (node.nodeType !== Node.TEXT_NODE || ["STYLE", "SCRIPT", "TITLE", "NOSCRIPT"].includes(el.tagName)) continue
        if (/icon/i.test(getComputedStyle(el).fontFamily)) continue  // the name of a picture
        const text = node.data.split(/\\s+/).filter((it) => it)
        if (!node.data.trim() || !shown(el)) continue
        const range = document.createRange()
        range.selectNodeContents(node)
        const box = range.getBoundingClientRect()
        if (box.width < 2 || box.height < 2 || box.bottom <= 0 || box.top >= innerHeight) continue
        words.push(...text)
        const size = getComputedStyle(el).fontSize
        sizes[size] = (sizes[size] ?? 0) + text.length
      }
      if (el.shadowRoot) look(el.shadowRoot)
    }
  }
  look(document)
  return {controls, words, sizes, figure}
}"""


def main() -> None:
    """Count and print."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0] if __doc__ else None)
    parser.add_argument("--save", type=Path, help="folder for a picture and the list of each size")
    save = parser.parse_args().save
    with sync_playwright() as p, _server(["wfsobs", "serve", "--port", "{port}"]) as url:
        browser = p.chromium.launch(executable_path=BROWSER, args=FLAGS)
        for name, (width, height) in SIZES.items():
            page = browser.new_page(viewport={"width": width, "height": height})
            page.goto(url)
            page.get_by_text("Done in").first.wait_for(state="attached", timeout=120_000)
            if width > 1000:  # with its drawer, whose settings come last
                page.get_by_role("button", name="Add peak").wait_for(state="attached", timeout=120_000)
            page.wait_for_function("() => document.fonts.status === 'loaded'")
            found = page.evaluate(COUNT)
            sizes = ", ".join(sorted(found["sizes"], key=lambda it: float(it[:-2])))
            print(f"{name:7s} {width} x {height}: {len(found['controls'])} controls, {len(found['words'])} words,", end=" ")
            print(f"{len(found['sizes'])} font sizes ({sizes}), first figure at {found['figure']:.0f} px")
            if save:
                save.mkdir(parents=True, exist_ok=True)
                page.screenshot(path=save / f"{name}.png")
                (save / f"{name}.txt").write_text("\n".join([*found["controls"], "", " ".join(found["words"])]), encoding="utf-8")
            page.close()
        browser.close()


if __name__ == "__main__":
    main()
