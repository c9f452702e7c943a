"""The package: what an import needs, and one version in all places."""

import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import modelselect

pytestmark = pytest.mark.no_cover

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))


def test_the_version_stands_in_one_place_and_the_citation_agrees():
    assert "version" in PROJECT["project"]["dynamic"] and "version" not in PROJECT["project"]
    source = PROJECT["tool"]["setuptools"]["dynamic"]["version"]
    assert source == {"attr": "modelselect.__version__"}
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert re.findall(r"^version: (.*)$", citation, re.M) == [modelselect.__version__]


@pytest.mark.unmutated
def test_a_robot_needs_no_more_than_numpy_and_scipy():
    needed = {re.split(r"[<>=]", name)[0] for name in PROJECT["project"]["dependencies"]}
    assert needed == {"numpy", "scipy"}
    # None in sys.modules makes an import fail.
    hidden = "import sys; sys.modules.update(dict.fromkeys(['matplotlib', 'tqdm']))"
    command = [sys.executable, "-c", f"{hidden}; import modelselect, perception"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_every_extra_that_draws_brings_what_landing_needs():
    extras = PROJECT["project"]["optional-dependencies"]
    assert {re.split(r"[<>=]", name)[0] for name in extras["landing"]} == {"matplotlib", "tqdm"}
    for extra in ("dev", "notebooks", "benchmarks"):
        assert "modelselect[landing]" in extras[extra], extra
