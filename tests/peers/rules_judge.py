"""Applies all rules of OWL 2 RL to a graph with owlrl, which shares no code with the rules of the plant.

    rules_judge.py GRAPH.nq

Prints a JSON line with the statements that follow, as N-Triples: those between named nodes whose
predicate is rdf:type, a hierarchy or a property of the plant, without the terms of RDF, RDFS and OWL
themselves.
"""

import sys

import owlrl
import rdflib
from rdflib.namespace import RDF, RDFS

import lifetime

DERIVED = rdflib.URIRef("urn:ua-bridge:graph:derived")
HIERARCHIES = (RDFS.subClassOf, RDFS.subPropertyOf)
# The namespaces of RDF, RDFS, OWL and the data types.
RESERVED = "http://www.w3.org/"


def is_of_users(term):
    return isinstance(term, rdflib.URIRef) and not term.startswith(RESERVED)


def is_wanted(statement):
    subject, predicate, target = statement
    if not is_of_users(subject) or not is_of_users(target):
        return False
    if predicate in HIERARCHIES:
        return subject != target
    return predicate == RDF.type or is_of_users(predicate)


def main():
    lifetime.bound(180.0)
    read = rdflib.Dataset()
    read.parse(sys.argv[1], format="nquads")
    graph = rdflib.Graph()
    for subject, predicate, target, context in read.quads():
        if context != DERIVED:
            graph.add((subject, predicate, target))
    stated = set(graph)
    owlrl.DeductiveClosure(owlrl.OWLRL_Semantics).expand(graph)
    derived = [one for one in graph if is_wanted(one) and one not in stated]
    lines = sorted(" ".join(term.n3() for term in one) for one in derived)
    lifetime.say(derived=lines)


main()
