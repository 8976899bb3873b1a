"""Checks recipes against the schemas of B2MML and BatchML with xmlschema.

    recipe_judge.py SCHEMA.xsd RECIPE.xml ...

Each recipe gets a JSON line with its faults.
"""

import sys

import xmlschema

import lifetime


def main():
    lifetime.bound(120.0)
    schema = xmlschema.XMLSchema(sys.argv[1], allow="local")
    for file in sys.argv[2:]:
        lifetime.say(faults=[f"{fault.path}: {fault.reason}" for fault in schema.iter_errors(file)])


main()
