"""Checks data against shapes with pySHACL, and compares its report with that of ua-mes.

    shacl_judge.py DATA.ttl SHAPES.ttl REPORT_URL

Prints a JSON line with the two reports: whether the data conforms, and each result as the focus
node, the path, the value, the severity and the component of the constraint.
"""

import sys
import urllib.request

import pyshacl
import rdflib
from rdflib.collection import Collection
from rdflib.namespace import RDF, SH

import lifetime


def text(term):
    """Returns a term as N-Triples writes it. Blank nodes have no name that two programs share."""
    if term is None:
        return None
    return "[]" if isinstance(term, rdflib.BNode) else term.n3()


def path(graph, node):
    """Returns a property path as a text: IRIs, lists and the paths that have one argument."""
    if not isinstance(node, rdflib.BNode):
        return text(node)
    if (node, RDF.first, None) in graph:
        return "(" + " ".join(path(graph, part) for part in Collection(graph, node)) + ")"
    parts = [f"{term.n3()} {path(graph, part)}" for term, part in graph.predicate_objects(node)]
    return "[" + " ; ".join(sorted(parts)) + "]"


def report(graph):
    head = graph.value(predicate=RDF.type, object=SH.ValidationReport)
    rows = []
    for result in graph.objects(head, SH.result):
        where = graph.value(result, SH.resultPath)
        row = [
            text(graph.value(result, SH.focusNode)),
            None if where is None else path(graph, where),
            text(graph.value(result, SH.value)),
            text(graph.value(result, SH.resultSeverity)),
            text(graph.value(result, SH.sourceConstraintComponent)),
        ]
        rows.append(row)
    rows.sort(key=str)
    return {"conforms": bool(graph.value(head, SH.conforms).toPython()), "results": rows}


def main():
    lifetime.bound(60.0)
    # A literal is compared as it is written.
    rdflib.NORMALIZE_LITERALS = False
    data, shapes, url = sys.argv[1:]
    ask = urllib.request.Request(url, headers={"Accept": "text/turtle"})
    with urllib.request.urlopen(ask, timeout=20) as answer:
        ours = rdflib.Graph().parse(data=answer.read(), format="turtle")
    read = [rdflib.Graph().parse(file, format="turtle") for file in (data, shapes)]
    _, theirs, _ = pyshacl.validate(read[0], shacl_graph=read[1], inference="none")
    lifetime.say(ours=report(ours), theirs=report(theirs))


main()
