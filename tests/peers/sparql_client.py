"""Queries and changes the knowledge of ua-mes with SPARQLWrapper, as any client of SPARQL 1.1 does.

    sparql_client.py URL

URL is that of the endpoint, as http://127.0.0.1:8087. Each request gets a JSON line.
"""

import sys

from rdflib import Graph
from SPARQLWrapper import GET, JSON, POST, TURTLE, XML, SPARQLWrapper, SPARQLExceptions

import lifetime

INSERT = 'INSERT DATA { <urn:w:a> <urn:w:p> 1 , 2.5 , "zwölf"@de . <urn:w:a> <urn:w:q> _:b }'
ALL = "SELECT ?p ?o WHERE { <urn:w:a> ?p ?o } ORDER BY ?p STR(?o)"


def request(url, text, format, method=POST):
    client = SPARQLWrapper(f"{url}/sparql", updateEndpoint=f"{url}/update")
    client.setQuery(text)
    client.setReturnFormat(format)
    client.setMethod(method)
    client.setTimeout(20)
    return client.query()


def rows(answer):
    found = [
        {name: [cell["type"], cell["value"]] for name, cell in row.items()}
        for row in answer.convert()["results"]["bindings"]
    ]
    for row in found:
        for cell in row.values():
            # The label of a blank node is the choice of the store.
            cell[1] = "" if cell[0] == "bnode" else cell[1]
    return found


def main():
    lifetime.bound(60.0)
    url = sys.argv[1]
    changed = request(url, INSERT, JSON)
    lifetime.say(request="insert", status=changed.response.status)
    for method in (GET, POST):
        lifetime.say(request="select", method=method, rows=rows(request(url, ALL, JSON, method)))
    # The XML of results, in place of the JSON.
    document = request(url, ALL, XML).convert()
    lifetime.say(request="select as XML", rows=len(document.getElementsByTagName("result")))
    for subject in ("a", "b"):
        told = request(url, f"ASK {{ <urn:w:{subject}> ?p ?o }}", JSON).convert()["boolean"]
        lifetime.say(request="ask", subject=subject, told=told)
    construct = "CONSTRUCT { ?o <urn:w:of> ?s } WHERE { ?s <urn:w:q> ?o }"
    made = Graph().parse(data=request(url, construct, TURTLE).convert(), format="turtle")
    lifetime.say(request="construct", objects=sorted(made.objects()))
    faults = [
        ("cut", "INSERT DATA { <urn:w:a> <urn:w:p> "),
        ("protected", "INSERT DATA { GRAPH <urn:ua-bridge:graph:derived> { <urn:w:a> <urn:w:p> 9 } }"),
        ("cut", "SELECT ?p WHERE { <urn:w:a> ?p "),
    ]
    for kind, text in faults:
        try:
            lifetime.say(request=kind, status=request(url, text, JSON).response.status)
        except SPARQLExceptions.QueryBadFormed as error:
            lifetime.say(request=kind, status=400, told=str(error))
        except SPARQLExceptions.EndPointInternalError as error:
            lifetime.say(request=kind, status=500, told=str(error))
        except Exception as error:  # SPARQLWrapper raises the error of urllib for other codes.
            lifetime.say(request=kind, status=getattr(error, "code", 0), told=str(error))
    lifetime.say(request="rows after faults", rows=len(rows(request(url, ALL, JSON))))
    request(url, "DELETE WHERE { <urn:w:a> ?p ?o }", JSON)
    lifetime.say(request="rows after delete", rows=len(rows(request(url, ALL, JSON))))


main()
