"""Checks a package of an asset administration shell with the test engines of its association.

    aas_judge.py FILE.aasx
"""

import sys

from aas_test_engines import file

import lifetime


def main():
    lifetime.bound(120.0)
    with open(sys.argv[1], "rb") as package:
        result = file.check_aasx_file(package)
    lines = list(result.to_lines())
    found = [line.split("Relationship ")[1] for line in lines if "Relationship " in line]
    parts = [line.split(" is ")[0] for line in found]
    lifetime.say(ok=result.ok(), parts=parts, faults=[] if result.ok() else lines)


main()
