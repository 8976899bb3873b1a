"""Queries a graph with rdflib, which shares no code with the store of the plant.

    knowledge_judge.py GRAPH.nq QUESTION.rq ...

The default graph is the merge of all named graphs. Each query gets a JSON line with its columns and
rows, with values as plain JSON.
"""

import json
import os
import sys

import rdflib

import lifetime


def plain(term):
    """Returns a number, a truth value or a text."""
    if term is None:
        return None
    if isinstance(term, rdflib.Literal):
        value = term.toPython()
        if isinstance(value, bool):
            return value
        if isinstance(value, (int, float)):
            return float(value)
    return str(term)


def main():
    lifetime.bound(180.0)
    # STR() returns a literal as it is written; rdflib would normalize it by default.
    rdflib.NORMALIZE_LITERALS = False
    known = rdflib.Dataset(default_union=True)
    known.parse(sys.argv[1], format="nquads")
    for path in sys.argv[2:]:
        with open(path, encoding="utf-8") as file:
            found = known.query(file.read())
        columns = [str(name) for name in found.vars]
        rows = [[plain(row[name]) for name in found.vars] for row in found]
        lifetime.say(question=os.path.basename(path), columns=columns, rows=rows)


main()
