"""Validates mappings with a JSON Schema: jsonschema and ruamel.yaml, which share no code with the
bridges.

A file with a list of entries is validated as the entries of `variables` or `patterns`. Each file
gets a JSON line with its faults.
"""

import json
import sys

import jsonschema
from ruamel.yaml import YAML

import lifetime

TOP = ("include", "type_paths", "spaces", "pubsub", "security", "server", "servers", "namespaces", "variables", "patterns", "calls")


def document(text):
    yaml = YAML(typ="safe", pure=True)
    found = yaml.load(text)
    if isinstance(found, list):
        # Entries with `topics` are entries of `patterns`.
        key = "patterns" if "topics" in found[0] else "variables"
        return {key: found}
    return found


def plain(value):
    """Returns the JSON form: the keys of a map are strings."""
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list):
        return [plain(item) for item in value]
    return value


def main():
    lifetime.bound(60.0)
    with open(sys.argv[1], encoding="utf-8") as file:
        schema = json.load(file)
    judge = jsonschema.Draft202012Validator(schema)
    judge.check_schema(schema)
    for path in sys.argv[2:]:
        with open(path, encoding="utf-8") as file:
            text = file.read()
        found = plain(document(text)) or {}
        faults = sorted(f"{error.json_path}: {error.message[:200]}" for error in judge.iter_errors(found))
        lifetime.say(file=path, faults=faults, keys=[key for key in found if key in TOP])


main()
