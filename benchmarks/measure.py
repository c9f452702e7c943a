"""Run one measurement in a process of its own; facts about the machine; tables."""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

RESULTS = Path(__file__).parent / "results"
ONE_THREAD = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")
USAGE = 2  # the exit code of argparse, and of Python without its script
PACKAGES = ("numpy", "scipy", "matplotlib", "pyscipopt", "gurobipy")


def run_alone(script: str, request: dict[str, Any], timeout: float) -> dict[str, Any]:
    """Run a script of this folder on a JSON request; return the JSON it prints last.

    If there is none, the answer is {"status": why}: a solver that refuses, crashes or hangs is a
    row of the table.  One that crashes as it leaves, its answer printed, has answered.  A script
    that is not there, or takes other arguments, is no row but our mistake: RuntimeError.
    """
    command = [sys.executable, str(Path(__file__).parent / script), json.dumps(request)]
    try:
        done = subprocess.run(
            command, env=os.environ | ONE_THREAD, timeout=timeout, capture_output=True, text=True
        )
    except subprocess.TimeoutExpired:
        return {"status": f"killed after {timeout:.0f} s"}
    if done.returncode == USAGE:
        raise RuntimeError(done.stderr)
    last = (done.stdout.splitlines() or [""])[-1]
    if not last.startswith("{"):
        return {"status": (done.stderr.strip().splitlines() or [f"exit {done.returncode}"])[-1]}
    answer: dict[str, Any] = json.loads(last)
    return answer


def peak_memory() -> float:
    """Most memory that this process has held, in MB (2^20 bytes).

    On Linux ru_maxrss also counts what the parent held when it started us, so it comes second.
    """
    try:
        status = Path("/proc/self/status").read_text()
        return float(status.split("VmHWM:")[1].split()[0]) / 1024
    except (OSError, IndexError):
        import resource

        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return peak / (2**20 if sys.platform == "darwin" else 2**10)


def machine() -> dict[str, Any]:
    """What the numbers depend on."""
    facts = {"cores": os.cpu_count(), "processor": _processor(), "system": platform.platform()}
    facts |= {"python": platform.python_version()}
    facts |= {package: found for package in PACKAGES if (found := _version(package))}
    return facts | {"threads": 1, "threads set by": " ".join(f"{k}=1" for k in ONE_THREAD)}


def _version(package: str) -> str | None:
    """A script that compares with no other solver runs without it."""
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    names = [line.split(":")[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def about(facts: dict[str, Any]) -> str:
    """One line on the machine, for below a table."""
    packages = ", ".join(f"{name} {facts[name]}" for name in PACKAGES if name in facts)
    return (
        f"Measured on {facts['cores']} cores ({facts['processor']}), Python {facts['python']}, "
        f"{packages}; one thread everywhere ({facts['threads set by']})."
    )


def table(rows: list[dict[str, str]]) -> str:
    """Markdown; the keys of the first row are the header."""
    lines = [list(rows[0]), ["---"] * len(rows[0]), *(list(row.values()) for row in rows)]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def claim(text: str, measured: str, holds: bool | None) -> dict[str, str]:
    """One line of the table of claims; None: this run cannot tell."""
    answer = {True: "yes", False: "**no**", None: "this run cannot tell"}[holds]
    return {"claim": text, "measured": measured, "holds": answer}


def seconds(value: float) -> str:
    """A time, to two or three digits."""
    return f"{value:.3f}" if value < 1 else f"{value:.3g}"


def by(rows: list[dict[str, Any]], *keys: str) -> dict[Any, list[dict[str, Any]]]:
    """Group rows by these entries, in order of appearance."""
    groups: dict[Any, list[dict[str, Any]]] = {}
    for row in rows:
        groups.setdefault(tuple(row[key] for key in keys), []).append(row)
    return groups


def save(folder: Path, name: str, text: str, data: dict[str, Any]) -> None:
    """Write name.md and name.json."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{name}.md").write_text(text, encoding="utf-8")
    numbers = json.dumps(data, indent=1, default=float)
    (folder / f"{name}.json").write_text(numbers + "\n", encoding="utf-8")
