"""Runs the published cases of RML with `ua-space rml` and with morph-kgc, and counts both.

    rml_judge.py UA_SPACE CASES

CASES is the folder of the cases. A case without a file of expected statements expects an error.
Prints a JSON line with the number of cases and, for each program, the number that passed and the
others by name. The exit code is 1 if a case fails with ua-space. morph-kgc needs numpy 1 and pandas 2.
"""

import os
import pathlib
import subprocess
import sys
import warnings

import morph_kgc
from pyoxigraph import CanonicalizationAlgorithm, Dataset, RdfFormat, parse

import lifetime

CONFIGURATION = """[CONFIGURATION]
logging_level: CRITICAL
output_format: N-QUADS
number_of_processes: 1
[CASE]
mappings: mapping.ttl
"""


def dataset(text):
    made = Dataset(parse(text.encode(), format=RdfFormat.N_QUADS))
    made.canonicalize(CanonicalizationAlgorithm.UNSTABLE)
    return made


def expected(case):
    for name in ("output.nq", "default.nq"):
        if (case / name).exists():
            return (case / name).read_text(encoding="utf-8")
    return None


def ua_space(program, case):
    command = [program, "rml", str(case / "mapping.ttl"), "--format", "nquads"]
    ran = subprocess.run(command, capture_output=True, text=True, timeout=30, check=False)
    return ran.stdout if ran.returncode == 0 else None


def morph(case):
    # morph-kgc reads files relative to the folder it runs in.
    os.chdir(case)
    try:
        statements = morph_kgc.materialize_set(CONFIGURATION)
    except (Exception, SystemExit):
        return None
    return "".join(f"{statement} .\n" for statement in statements)


def passes(made, wanted):
    """Returns whether the output is as wanted; `None` stands for an error."""
    if made is None or wanted is None:
        # The graph of one case is a literal: nothing is expected, and an error is as good.
        return made is None and not (wanted or "").strip()
    try:
        return dataset(made) == dataset(wanted)
    except SyntaxError:
        return False


def main():
    lifetime.bound(480.0)
    warnings.simplefilter("ignore")
    program = os.path.abspath(sys.argv[1])
    folder = pathlib.Path(sys.argv[2]).resolve()
    cases = sorted(case for case in folder.iterdir() if (case / "mapping.ttl").exists())
    failed = {"ua-space": [], "morph-kgc": []}
    for case in cases:
        wanted = expected(case)
        for name, made in (("ua-space", ua_space(program, case)), ("morph-kgc", morph(case))):
            if not passes(made, wanted):
                failed[name].append(case.name)
    counts = {name: len(cases) - len(those) for name, those in failed.items()}
    lifetime.say(cases=len(cases), passed=counts, failed=failed)
    sys.stdout.flush()
    sys.exit(1 if failed["ua-space"] or not cases else 0)


main()
