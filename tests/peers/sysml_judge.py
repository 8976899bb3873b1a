"""Counts the topics, nodes and calls of a UML model with the XML parser of Python (expat).

    sysml_judge.py MODEL

Prints a JSON line: the ROS topics, services and actions by their stereotypes, and the properties
that have a stereotype.
"""

import sys
from xml.parsers import expat

import lifetime

STEREOTYPES = {"Ros1Topic": "topic", "Ros2Topic": "topic", "Ros1Service": "service", "Ros2Service": "service",
               "Ros1Action": "server", "Ros2Action": "server", "UaNode": "node"}


def main():
    lifetime.bound(60.0)
    names, marked, calls = [], set(), set()
    depth = 0

    def start(tag, attributes):
        nonlocal depth
        depth += 1
        stereotype = tag.split(":")[-1]
        if depth != 2 or stereotype not in STEREOTYPES:
            return
        key = STEREOTYPES[stereotype]
        if key != "node":
            names.append(attributes[key])
        if "base_Property" in attributes:
            marked.add(attributes["base_Property"])
        if "base_Operation" in attributes:
            calls.add(attributes["base_Operation"])

    def end(_):
        nonlocal depth
        depth -= 1

    parser = expat.ParserCreate()
    parser.StartElementHandler = start
    parser.EndElementHandler = end
    with open(sys.argv[1], "rb") as model:
        parser.ParseFile(model)
    lifetime.say(names=sorted(names), properties=len(marked), calls=len(calls))


main()
