"""The dashboard in a notebook."""

import subprocess
import sys
from urllib.error import URLError
from urllib.request import urlopen

import pytest

import wfsobs


def test_a_cell_shows_the_page_with_the_settings_given_and_gives_them_back() -> None:
    scenario = wfsobs.PRESETS["paper"]().replace({"run.duration": 1.5, "turbulence.wind_speed": 12.5})
    page = wfsobs.explore(scenario, height=700)
    try:
        assert f'src="{page.url}"' in page._repr_html_() and "height: 700px" in page._repr_html_()
        assert page.scenario is scenario and page.result is None  # nobody has opened it
        with urlopen(page.url, timeout=120) as answer:
            assert "wfsobs" in answer.read().decode()
        assert page.scenario.to_dict() == scenario.to_dict()
    finally:
        page.close()
    with pytest.raises(URLError):
        urlopen(page.url, timeout=5)


def test_a_program_that_shows_the_page_ends() -> None:
    """At a prompt the page is named by its address; it does not keep Python from ending."""
    program = "import wfsobs; print(wfsobs.explore(wfsobs.Scenario()))"
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=120, check=True)
    assert "http://localhost:" in ended.stdout and ended.stderr == ""
