"""Queries and changes the knowledge of ua-mes by TLS, with Python's own TLS library: mes_tls.py PORT CERTIFICATE PASSWORD

Prints a JSON object per request: its name, the status and the text."""

import base64
import http.client
import json
import socket
import ssl
import sys
from concurrent.futures import ThreadPoolExecutor

port, certificate, password = int(sys.argv[1]), sys.argv[2], sys.argv[3]
with open(certificate, "rb") as file:
    der = file.read()


def context(known=True):
    made = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    if known:
        made.load_verify_locations(cadata=der)
    return made


def show(name, **found):
    sys.stdout.write(json.dumps({"name": name, **found}) + "\n")
    sys.stdout.flush()


def basic(user, secret):
    return {"Authorization": "Basic " + base64.b64encode(f"{user}:{secret}".encode()).decode()}


def request(name, method, path, headers, body=None, media=None):
    link = http.client.HTTPSConnection("localhost", port, timeout=30, context=context())
    if media:
        headers = {**headers, "Content-Type": media}
    link.request(method, path, body, headers)
    answer = link.getresponse()
    show(name, code=answer.status, text=answer.read().decode())
    link.close()


try:
    with socket.create_connection(("localhost", port), 5) as plain:
        plain.sendall(b"GET /ask HTTP/1.1\r\nHost: localhost\r\n\r\n")
        show("clear", answered=b"HTTP/1.1" in plain.recv(1000))
except OSError as error:
    show("clear", answered=False, error=str(error))
try:
    with socket.create_connection(("localhost", port), 5) as raw:
        context(known=False).wrap_socket(raw, server_hostname="localhost")
    show("stranger", trusted=True)
except ssl.SSLCertVerificationError:
    show("stranger", trusted=False)
for name, version in [("TLS 1.1", ssl.TLSVersion.TLSv1_1), ("TLS 1.2", ssl.TLSVersion.TLSv1_2), ("TLS 1.3", ssl.TLSVersion.TLSv1_3)]:
    of_version = context()
    of_version.set_ciphers("ALL:@SECLEVEL=0")
    of_version.minimum_version = of_version.maximum_version = version
    try:
        with socket.create_connection(("localhost", port), 5) as raw, of_version.wrap_socket(raw, server_hostname="localhost") as made:
            show(name, version=made.version())
    except ssl.SSLError as error:
        show(name, version=None, reason=error.reason)

INSERT = "INSERT DATA { GRAPH <urn:remote> { <urn:a> <urn:p> 'remote' } }"
SELECT = "SELECT ?o { GRAPH <urn:remote> { ?s <urn:p> ?o } }"
UPDATE, QUERY, TURTLE = "application/sparql-update", "application/sparql-query", "text/turtle"
otto, anna = basic("otto", password), basic("anna", password)
request("nobody", "GET", "/status", {})
request("wrong password", "GET", "/ask/sources", basic("otto", "guess"))
request("other name", "GET", "/ask/sources", {**otto, "Host": "rebound.example"})
request("reader", "GET", "/ask/sources", otto)
request("reader writes", "POST", "/update", otto, INSERT, UPDATE)
request("engineer writes", "POST", "/update", anna, INSERT, UPDATE)
request("engineer puts", "PUT", "/store?graph=urn:put", anna, "<urn:b> <urn:p> 'put' .", TURTLE)
csv = {**otto, "Accept": "text/csv"}
request("reader queries", "POST", "/sparql", csv, SELECT, QUERY)
request("reader gets", "GET", "/store?graph=urn:put", {**otto, "Accept": "application/n-triples"})
for method, path, media in [
    ("PUT", "/store?graph=urn:put", TURTLE),
    ("POST", "/store?graph=urn:put", TURTLE),
    ("DELETE", "/store?graph=urn:put", None),
    ("PUT", "/sources/file/stolen", TURTLE),
    ("DELETE", "/sources/file/stolen", None),
    ("POST", "/configuration", "application/xml"),
    ("POST", "/jobs", "application/json"),
]:
    request(f"reader: {method} {path}", method, path, otto, "{}" if media else None, media)
request("reader gets it again", "GET", "/store?graph=urn:put", {**otto, "Accept": "application/n-triples"})
# The last requests, because this host is locked for a minute then.
with ThreadPoolExecutor(30) as all_at_once:
    for number in range(30):
        all_at_once.submit(request, f"guess {number}", "GET", "/ask", basic("anna", f"guess {number}"))
request("locked", "GET", "/ask", anna)
