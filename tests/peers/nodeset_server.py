"""Serves NodeSets with the HTTP server of Python, with or without TLS.

A path `/sets/NAME` is the file whose model has the unescaped NAME as its URI. Other paths are files
of the folder. `/sets/urn%3Amoved` is redirected, and `/sets/urn%3Asilent` has no response.

Each request is one JSON line.
"""

import argparse
import functools
import http.server
import pathlib
import re
import ssl
import threading
import urllib.parse

import lifetime


class Handler(http.server.SimpleHTTPRequestHandler):
    def do_GET(self):
        lifetime.say(path=self.path, user=self.headers.get("Authorization"))
        name = urllib.parse.urlsplit(self.path).path
        if name.startswith("/sets/"):
            uri = urllib.parse.unquote(name.removeprefix("/sets/").removesuffix(".xml"))
            if uri == "urn:silent":
                threading.Event().wait()
            if uri == "urn:moved":
                self.send_response(302)
                self.send_header("Location", "ftp://127.0.0.1/moved.xml")
                self.end_headers()
                return
            self.path = f"/{self.file_of(uri)}"
        super().do_GET()

    def file_of(self, uri):
        model = re.compile(rf'<Model ModelUri="{re.escape(uri)}"')
        files = pathlib.Path(self.directory).glob("*.xml")
        return next((file.name for file in files if model.search(file.read_text())), "missing")

    def log_message(self, *_):
        pass


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("folder")
    parser.add_argument("port", type=int)
    parser.add_argument("--certificate")
    parser.add_argument("--key")
    arguments = parser.parse_args()
    lifetime.bound(300)
    handler = functools.partial(Handler, directory=arguments.folder)
    server = http.server.ThreadingHTTPServer(("127.0.0.1", arguments.port), handler)
    server.daemon_threads = True
    if arguments.certificate:
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        context.load_cert_chain(arguments.certificate, arguments.key)
        server.socket = context.wrap_socket(server.socket, server_side=True)
    lifetime.say(ready=True)
    server.serve_forever()


main()
