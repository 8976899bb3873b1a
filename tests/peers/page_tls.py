"""Signs in on the page by TLS, with Python's own TLS library: page_tls.py PORT CERTIFICATE PASSWORD

Prints a JSON object per request: its path, the status and some headers."""

import http.client
import json
import socket
import ssl
import sys

port, certificate, password = int(sys.argv[1]), sys.argv[2], sys.argv[3]
with open(certificate, "rb") as file:
    der = file.read()


def context(known=True):
    made = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    if known:
        made.load_verify_locations(cadata=der)
    return made


def show(name, **found):
    print(json.dumps({"name": name, **found}), flush=True)


def request(name, method, path, body=None, cookie="", host=None):
    link = http.client.HTTPSConnection("localhost", port, timeout=5, context=context())
    headers = {"Cookie": cookie}
    if host:
        headers["Host"] = host
    if body is not None:
        body = json.dumps(body)
        headers.update({"Content-Type": "application/json", "Origin": f"https://localhost:{port}"})
    link.request(method, path, body, headers)
    answer = link.getresponse()
    media = answer.getheader("content-type", "")
    # An event stream has no end.
    text = "" if media.startswith("text/event-stream") else answer.read().decode()
    made = answer.getheader("set-cookie", "")
    show(name, code=answer.status, cookie=made, tls=link.sock.version() if link.sock else None,
         text=json.loads(text) if media.startswith("application/json") and text else text[:80])
    link.close()
    return made.split(";")[0]


try:
    with socket.create_connection(("localhost", port), 5) as plain:
        plain.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n")
        show("clear", page=b"HTTP/1.1" in plain.recv(1000))
except OSError as error:
    show("clear", page=False, error=str(error))
try:
    with socket.create_connection(("localhost", port), 5) as raw:
        context(known=False).wrap_socket(raw, server_hostname="localhost")
    show("stranger", trusted=True)
except ssl.SSLCertVerificationError:
    show("stranger", trusted=False)
request("start", "GET", "/")
request("session", "GET", "/session")
request("unknown reader", "GET", "/events?view=programs")
request("other site", "GET", "/", host="rebound.example")
request("status", "GET", "/status")
request("wrong password", "POST", "/sign-in", {"user": "anna", "password": "guess"})
cookie = request("sign-in", "POST", "/sign-in", {"user": "anna", "password": password})
request("reader", "GET", "/events?view=programs", cookie=cookie)
