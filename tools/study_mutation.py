"""Mutation testing of the factors, the stage's gate and the verdict: does a test fail where the code is wrong?

cosmic-ray (group `mutation`) changes one operator, number or condition at a time in a copy of this checkout, and runs
the tests of that part. Kept are the changes that could pass for an honest slip: arithmetic for other arithmetic, a
comparison for its neighbour or opposite, a condition negated, a number off by one. Shifts, bit operations and changes
within type annotations are not.

    python tools/study_mutation.py --parts factors gate verdict --mutants 300 --seed 1

A mutant that survives and means the same as the original (an equivalent one) is listed in EQUIVALENT of this file.
"""

from __future__ import annotations

import argparse
import json
import random
import shutil
import sqlite3
import subprocess
import sys
import tempfile
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
IGNORED = shutil.ignore_patterns(".git", ".venv*", "out", "*.rrd", "__pycache__", ".*_cache", ".hypothesis")
TIMEOUT_S = 120.0


@dataclass(frozen=True, slots=True)
class Part:
    """Files to change, and the tests that must notice."""

    modules: tuple[str, ...]
    tests: tuple[str, ...]


PARTS = {
    "factors": Part(
        (
            "factors/adapter.py",
            "factors/epoch_change.py",
            "factors/known_point.py",
            "factors/marker_pose.py",
            "factors/point_on_arc.py",
            "factors/point_on_line.py",
            "factors/rig.py",
            "factors/sensitivity_prior.py",
            "factors/visible_spot.py",
        ),
        (
            "tests/test_factor_adapter.py",
            "tests/test_factor_epoch_change.py",
            "tests/test_factor_known_point.py",
            "tests/test_factor_marker_pose.py",
            "tests/test_factor_point_on_arc.py",
            "tests/test_factor_point_on_line.py",
            "tests/test_factor_rig.py",
            "tests/test_factor_sensitivity_prior.py",
            "tests/test_factor_visible_spot.py",
        ),
    ),
    "gate": Part(
        ("fgreg/stage/safety_gate.py", "fgreg/stage/limits.py"),
        (
            "tests/test_stage_gate_limits.py",
            "tests/test_stage_safety_gate.py",
            "tests/test_stage_messages.py",
            "tests/test_stage_safety_gate_properties.py",
        ),
    ),
    "verdict": Part(
        ("fgreg/registration/verdict.py",),
        ("tests/test_verdict_limits.py", "tests/test_verdict_hypotheses.py", "tests/test_verdict_refusals.py"),
    ),
}
ARITHMETIC = {"Add": "Sub", "Sub": "Add", "Mul": "Div", "Div": "Mul", "Mod": "Add", "Pow": "Mul", "FloorDiv": "Mul"}
COMPARISON = {
    "Eq": ("NotEq",),
    "NotEq": ("Eq",),
    "Lt": ("LtE", "Gt"),
    "LtE": ("Lt", "GtE"),
    "Gt": ("GtE", "Lt"),
    "GtE": ("Gt", "LtE"),
    "Is": ("IsNot",),
    "IsNot": ("Is",),
    "In": ("NotIn",),
    "NotIn": ("In",),
}
KEPT = {
    "core/NumberReplacer",
    "core/AddNot",
    "core/ReplaceAndWithOr",
    "core/ReplaceOrWithAnd",
    "core/ReplaceTrueWithFalse",
    "core/ReplaceFalseWithTrue",
    "core/ReplaceBreakWithContinue",
    "core/ReplaceContinueWithBreak",
    "core/ZeroIterationForLoop",
    "core/ReplaceUnaryOperator_USub_UAdd",
    "core/ReplaceUnaryOperator_Delete_USub",
    "core/ReplaceUnaryOperator_Delete_Not",
    *(f"core/ReplaceBinaryOperator_{a}_{b}" for a, b in ARITHMETIC.items()),
    *(f"core/ReplaceComparisonOperator_{a}_{b}" for a, others in COMPARISON.items() for b in others),
}
EQUIVALENT: dict[str, str] = {}
"""`module: changed line` of mutants that mean the same, with the reason."""


def configuration(part: Part) -> str:
    command = " ".join([sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", *part.tests])
    return "\n".join(
        [
            "[cosmic-ray]",
            f"module-path = {json.dumps(list(part.modules))}",
            f"timeout = {TIMEOUT_S}",
            "excluded-modules = []",
            f"test-command = {json.dumps(command)}",
            "[cosmic-ray.distributor]",
            'name = "local"',
            "",
        ]
    )


def choose(database: Path, mutants: int, seed: int) -> int:
    """Keep the kinds of KEPT, and of these a random sample; returns the number of all of these kinds."""
    with sqlite3.connect(database) as connection:
        rows = connection.execute("SELECT job_id, operator_name FROM mutation_specs ORDER BY module_path, "
                                  "operator_name, occurrence, operator_args").fetchall()  # fmt: skip
        honest = [job for job, operator in rows if operator in KEPT]
        sample = set(random.Random(seed).sample(honest, min(mutants, len(honest))))
        for job, _ in rows:
            if job not in sample:
                connection.execute("DELETE FROM mutation_specs WHERE job_id = ?", (job,))
                connection.execute("DELETE FROM work_items WHERE job_id = ?", (job,))
    return len(honest)


def changed_line(diff: str) -> str:
    """The changed lines of a diff, `- before | + after`."""
    lines = [line.strip() for line in diff.splitlines() if line[:1] in "+-" and line[:3] not in ("+++", "---")]
    return " | ".join(" ".join(line.split()) for line in lines)


def run(name: str, part: Part, mutants: int, seed: int, cosmic_ray: str) -> tuple[int, int]:
    """Number killed, and number that could have been."""
    with tempfile.TemporaryDirectory() as scratch:
        copy = Path(scratch) / "checkout"
        shutil.copytree(ROOT, copy, symlinks=True, ignore=IGNORED)
        config, database = Path(scratch) / "part.toml", Path(scratch) / "part.sqlite"
        config.write_text(configuration(part), encoding="utf-8")
        for words in (["init", config, database], ["baseline", config]):
            subprocess.run([cosmic_ray, *map(str, words)], cwd=copy, check=True)
        honest = choose(database, mutants, seed)
        subprocess.run([cosmic_ray, "exec", str(config), str(database)], cwd=copy, check=True)
        with sqlite3.connect(database) as connection:
            results = connection.execute(
                "SELECT m.module_path, m.start_pos_row, r.test_outcome, r.diff FROM work_results r "
                "JOIN mutation_specs m USING (job_id) ORDER BY 1, 2"
            ).fetchall()
    outcomes: Counter[str] = Counter()
    for module, row, outcome, diff in results:
        line = changed_line(diff or "")
        same = f"{module}: {line}" in EQUIVALENT
        outcomes["equivalent" if same else str(outcome).lower()] += 1
        if not same and "survived" in str(outcome).lower():
            print(f"survived: {module}:{row}: {line}")
    real = sum(outcomes.values()) - outcomes["equivalent"]
    killed = sum(count for outcome, count in outcomes.items() if "killed" in outcome)
    print(f"{name}: {killed} of {real} killed, {100 * killed / max(real, 1):.1f} % "
          f"({len(results)} drawn of {honest}; {outcomes['equivalent']} mean the same)", flush=True)  # fmt: skip
    return killed, real


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--parts", nargs="+", choices=list(PARTS), default=list(PARTS))
    parser.add_argument("--mutants", type=int, default=10_000, help="drawn of each part (default: all)")
    parser.add_argument("--seed", type=int, default=1, help="of the draw")
    parser.add_argument("--cosmic-ray", default="cosmic-ray", metavar="PROGRAM")
    args = parser.parse_args()
    for name in args.parts:
        run(name, PARTS[name], args.mutants, args.seed, args.cosmic_ray)


if __name__ == "__main__":
    main()
