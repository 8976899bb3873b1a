"""Loads NodeSet files one after the other into its own server, and prints their object types and
the values of their variables, the dictionary entries of the types, and what an XML schema finds.

opcua_import.py [--xsd UANodeSet.xsd] FILE...
"""

import asyncio
import json
import logging
import sys

from asyncua import Server, ua


class Complaints(logging.Handler):
    def __init__(self):
        super().__init__(logging.WARNING)
        self.said = []

    def emit(self, record):
        self.said.append(record.getMessage())


async def type_of(node):
    """Returns the name of the object type that contains the node at any depth: two types may have
    variables of the same name."""
    while node is not None and await node.read_node_class() != ua.NodeClass.ObjectType:
        node = await node.get_parent()
    return None if node is None else (await node.read_browse_name()).Name


def faults_of(file, schema):
    """Returns the faults of a file by an XML schema; None without lxml."""
    try:
        from lxml import etree
    except ImportError:
        return None
    judge = etree.XMLSchema(etree.parse(schema))
    judge.validate(etree.parse(file))
    return [str(fault) for fault in judge.error_log]


async def main():
    server = Server()
    await server.init()
    complaints = Complaints()
    logging.getLogger("asyncua.common.xmlimporter").addHandler(complaints)
    logging.getLogger("asyncua.common.xmlparser").addHandler(complaints)
    files, schema = sys.argv[1:], None
    if files[0] == "--xsd":
        schema, files = files[1], files[2:]
    for file in files:
        types, values, entries = {}, {}, {}
        for node in await server.import_xml(file):
            node = server.get_node(node)
            name = (await node.read_browse_name()).Name
            kind = await node.read_node_class()
            if kind == ua.NodeClass.ObjectType:
                above = await node.get_referenced_nodes(ua.ObjectIds.HasSubtype, ua.BrowseDirection.Inverse)
                types[name] = [(await of.read_browse_name()).Name for of in above]
                meant = await node.get_referenced_nodes(ua.ObjectIds.HasDictionaryEntry)
                entries[name] = [(await of.read_browse_name()).Name for of in meant]
            elif kind == ua.NodeClass.Variable:
                value = (await node.read_data_value(raise_on_bad_status=False)).Value
                if value is not None and isinstance(value.Value, (int, float, str)):
                    values[f"{await type_of(node)}.{name}"] = value.Value
        faults = faults_of(file, schema) if schema else None
        print(
            json.dumps(
                {
                    "types": types,
                    "values": values,
                    "entries": entries,
                    "complaints": complaints.said,
                    "faults": faults,
                }
            ),
            flush=True,
        )


asyncio.run(main())
