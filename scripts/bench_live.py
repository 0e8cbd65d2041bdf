"""Measure a live loop and its server beside an empty paced loop.

    python scripts/bench_live.py [--seconds 60] [--pages 5] [--port 5930] [--browser]

Starts `wfsobs live` on the preset paper with all linear observers and the online GPR, opens pages by websocket without a browser
that answer each picture as one that has painted it, and runs two empty loops of the same pace in processes of their own. Prints
one JSON object: frames and lost frames; the shares of frames that were late by more than 1 ms: an estimate of the slowest
observer (`late_share`), what the source sent (`late_share_sent`), the empty loop (`late_share_empty`), and one that goes first as
the source does where the system lets it (`late_share_empty_first`, `goes_first`); how far the observers were behind, sampled
every second [s]; processor time of the server and all its processes over time [cores], and of each (`cores_of_processes`: the
server, two of the source, observers, learners, workshop and controllers, in this order unless one takes nothing); memory,
proportional set size after the first minute (or the first tenth), at the end, and at most [MB]; pictures a second that each page
has received; how far they were behind the source as they came (`page_behind_s`), and what is on the page just before the next one
comes (`page_behind_before_next_s`) [s]. It begins once every page has shown twenty pictures. With --browser one more page stands
in Chromium, whose processor time does not count: how long it takes to show the present, and how far behind the source it is from
then on, read twice a second [s]. What is asked of each follows in a line, passed or missed.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import subprocess
import sys
import time
from multiprocessing import Manager, Process, Queue, Value
from urllib.request import urlopen

from live_pages import SHOWN, lags_of, watch_pages
from measure_dashboard import BROWSER
from playwright.sync_api import sync_playwright
from usage import cpu_seconds, family, memory_mb

from wfsobs import PRESETS
from wfsobs.live.checks import observers_on
from wfsobs.live.simulated import SimulatedLoop
from wfsobs.live.source import SOURCE, go_first, prefer
from wfsobs.observers import OBSERVERS

DT, LATE = 1e-3, 1e-3
PAGE_BEHIND, PICTURES = 0.5, 5.0
"""[s], per second"""
WEIGHED = 10.0
"""Time between two looks at the memory [s]: each holds up the process that it is of, and on some kernels a processor."""
VISITS = -10
"""Niceness of the pages without a browser."""
SETTLED = 20
"""Pictures of every page before the measurement begins."""


def run_empty(late, frames, end, first=None) -> None:
    """Wake every millisecond and do nothing; first : whether it goes first, as the source does, is set where it is given."""
    if first is not None:
        first.value = go_first(SOURCE)
    due = time.monotonic() + DT
    while not end.value:
        if (wait := due - time.monotonic()) > 0:
            time.sleep(wait)
        late.value += time.monotonic() - due > LATE
        frames.value += 1
        due += DT


def visit(base: str, pages: int, pictures) -> None:
    """Open pages, and keep them open; as those of another machine they do not wait for a processor of this one."""
    prefer(VISITS)
    asyncio.run(watch_pages(base, pages, pictures))


def watch(url: str, opened, lags, end) -> None:
    """Keep one page in a browser: note how long it takes to show the present, and from then on how far it is behind."""
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=BROWSER, args=["--no-sandbox", "--disable-gpu"])
        page, start = browser.new_page(viewport={"width": 1400, "height": 1000}), time.monotonic()
        page.goto(url)
        shown = page.get_by_text(SHOWN)
        shown.wait_for(timeout=120_000)
        while not end.value:
            found, now = SHOWN.search(shown.inner_text()), counts(url)
            assert found is not None
            lag = sent_seconds(now) - float(found[1])
            if opened.value:
                lags.append(round(lag, 3))
                time.sleep(0.5)
            elif lag <= PAGE_BEHIND:
                opened.value = time.monotonic() - start
        browser.close()


def counts(url: str) -> dict:
    """Return what the server counts of the loop."""
    with urlopen(f"{url}/liveness", timeout=120) as answer:
        return json.load(answer).get("live", {})


def sent_seconds(now: dict) -> float:
    """Return the time of the newest frame that the source has sent [s]."""
    return (now["frames"] + now["lost"]) * DT + now["behind_s"]


def chosen_observers() -> list[str]:
    """Return every linear observer that runs frame by frame on the preset, and the online GPR."""
    paper = PRESETS["paper"]()
    return [name for name in observers_on(SimulatedLoop(paper), paper) if OBSERVERS[name].linear or name == "gpr-online"]


def judge(result: dict) -> dict[str, bool]:
    """Say of every number whether it is as good as is asked."""
    memory, shown = result["memory_mb"], result["browser_behind_s"]
    bars = {
        "no frame lost": result["lost"] == 0,
        "late at most 0.1 percentage points above the empty loop": result["late_share"] <= result["late_share_empty"] + 1e-3,
        "late at most 0.1 percentage points above the empty loop of the same turn": (
            result["late_share"] <= result["late_share_empty_first"] + 1e-3
        ),
        "source and server below 1.5 cores": result["cores"] < 1.5,
        "memory within 5 %": memory["most"] <= 1.05 * memory["settled"] and memory["end"] >= 0.95 * memory["settled"],
    }
    if rates := result["pictures_per_s"]:
        bars[f"pages at most {PAGE_BEHIND} s behind"] = result["page_behind_before_next_s"]["max"] <= PAGE_BEHIND
        bars[f"{PICTURES:g} pictures a second"] = min(rates) >= PICTURES
    return bars | ({f"browser at most {PAGE_BEHIND} s behind": shown["max"] <= PAGE_BEHIND} if shown else {})


def main() -> None:
    """Run it."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--pages", type=int, default=5)
    parser.add_argument("--port", type=int, default=5930)
    parser.add_argument("--browser", action="store_true")
    a = parser.parse_args()
    url = f"http://localhost:{a.port}"
    chosen = [word for name in chosen_observers() for word in ("--observer", name)]
    server = subprocess.Popen([sys.executable, "-m", "wfsobs", "live", "--port", str(a.port), *chosen], stderr=subprocess.DEVNULL)
    late, frames, late_first, frames_first = (Value("q", 0) for _ in range(4))
    end, first_of_all = Value("b", 0), Value("b", 0)
    pictures, polls, told = Queue(), [], []
    visitors = Process(target=visit, args=(f"localhost:{a.port}", a.pages, pictures), daemon=True)
    empties = [
        Process(target=run_empty, args=(late, frames, end), daemon=True),
        Process(target=run_empty, args=(late_first, frames_first, end, first_of_all), daemon=True),
    ]
    lags, opened = Manager().list(), Value("d", 0.0)
    browser = Process(target=watch, args=(url, opened, lags, end))
    try:
        ready = time.monotonic() + 240.0
        while time.monotonic() < ready:
            try:
                if counts(url).get("frames", 0) > 1000:
                    break
            except OSError:
                pass
            time.sleep(0.5)
        visitors.start()
        if a.browser:
            browser.start()
        while a.pages and time.monotonic() < ready:  # the pages are open, and nothing that belongs to it goes on
            told.append(pictures.get(timeout=120.0))
            if min(sum(page == number for page, _ in told) for number in range(a.pages)) >= SETTLED:
                break
        time.sleep(5.0)
        for empty in empties:
            empty.start()
        before = {pid: cpu_seconds([pid]) for pid in family(server.pid)}
        first, start = counts(url), time.monotonic()
        behind, memory = [], []
        while (elapsed := time.monotonic() - start) < a.seconds:
            time.sleep(1.0)
            now = counts(url)
            behind.append(now["behind_s"])
            polls.append((time.monotonic(), sent_seconds(now)))
            while not pictures.empty():
                told.append(pictures.get())
            if not memory or elapsed - memory[-1][0] >= WEIGHED:
                memory.append((elapsed, memory_mb(family(server.pid))))
        memory.append((elapsed, memory_mb(family(server.pid))))
        last, seconds = counts(url), time.monotonic() - start
        each = {pid: cpu_seconds([pid]) - before.get(pid, 0.0) for pid in {*before, *family(server.pid)}}
        used = cpu_seconds(family(server.pid)) - sum(before.values())
        end.value = 1
        for empty in empties:
            empty.join(5)
        if a.browser:
            browser.join(30)
        shown = sorted(lags)
        taken = last["frames"] - first["frames"]
        late_shares = {
            name: round((last[name] * last["frames"] - first[name] * first["frames"]) / max(taken, 1), 5)
            for name in ("late_share", "late_share_sent")
        }
        settled = min(60.0, 0.1 * a.seconds)
        settled_mb = next(mb for at, mb in memory if at >= settled)
        result = {
            "seconds": round(seconds, 1),
            "frames": taken,
            "lost": last["lost"] - first["lost"],
            **late_shares,
            "late_share_empty": round(late.value / max(frames.value, 1), 5),
            "late_share_empty_first": round(late_first.value / max(frames_first.value, 1), 5),
            "goes_first": bool(first_of_all.value),
            "behind_s": {"median": sorted(behind)[len(behind) // 2], "max": max(behind)},
            "cores": round(used / seconds, 3),
            "cores_of_processes": [round(own / seconds, 3) for _, own in sorted(each.items()) if own > 0],
            "memory_mb": {
                "settled": round(settled_mb, 1),
                "end": round(memory[-1][1], 1),
                "most": round(max(mb for at, mb in memory if at >= settled), 1),
            },
            **lags_of(told, polls, start),
            "browser_opened_s": round(opened.value, 1) if a.browser else None,
            "browser_behind_s": {"median": shown[len(shown) // 2], "max": shown[-1]} if shown else None,
            "load": os.getloadavg()[0],
        }
        print(json.dumps(result))
        for name, holds in judge(result).items():
            print(f"{'passed' if holds else 'missed'}: {name}")
    finally:
        end.value = 1
        for process in (visitors, browser, *empties):
            if process.pid:
                process.kill()
        server.terminate()
        server.wait(60)


if __name__ == "__main__":
    main()
