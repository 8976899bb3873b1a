#!/usr/bin/env python3
"""Runs asyncua as the administrator of a server's certificates.

It has the server create a signing request, issues the certificate with its own authority, and
updates the certificate of the server.
"""

import argparse
import asyncio
import os
import pathlib

from asyncua import Client, ua
from asyncua.common.utils import Buffer
from asyncua.ua.ua_binary import struct_from_binary, struct_to_binary
from asyncua.ua.uaerrors import UaStatusCodeError
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization

import lifetime
import opcua_access
import opcua_session

IDS = ua.ObjectIds
GROUP = "ServerConfiguration_CertificateGroups_DefaultApplicationGroup"


def node_id(name):
    return ua.NodeId(getattr(IDS, name))


class Server:
    """Accesses the ServerConfiguration of a server."""

    def __init__(self, client):
        self.configuration = client.get_node(node_id("ServerConfiguration"))
        self.list = client.get_node(node_id(f"{GROUP}_TrustList"))

    async def call(self, name, *arguments):
        return await self.configuration.call_method(node_id(f"ServerConfiguration_{name}"), *arguments)

    async def file(self, name, *arguments):
        return await self.list.call_method(node_id(f"{GROUP}_TrustList_{name}"), *arguments)

    async def trusted(self):
        handle = word(await self.file("Open", ua.Variant(1, ua.VariantType.Byte)))
        content = b""
        while part := await self.file("Read", handle, ua.Variant(1000, ua.VariantType.Int32)):
            content += part
        await self.file("Close", handle)
        return struct_from_binary(ua.TrustListDataType, Buffer(content))

    async def trust(self, trusted):
        content = struct_to_binary(trusted)
        handle = word(await self.file("Open", ua.Variant(6, ua.VariantType.Byte)))
        for begin in range(0, len(content), 1000):
            await self.file("Write", handle, content[begin : begin + 1000])
        return await self.file("CloseAndUpdate", handle)


def word(value):
    return ua.Variant(value, ua.VariantType.UInt32)


async def outcome(awaited):
    try:
        await awaited
        return "Good"
    except UaStatusCodeError as refused:
        return ua.StatusCode(refused.code).name


def certificate_for(request, authority, uri=None):
    """Returns the certificate that an authority issues for a signing request."""
    names = request.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    if uri:
        names = x509.SubjectAlternativeName([x509.UniformResourceIdentifier(uri)])
    key, own = authority
    now = opcua_access.datetime.datetime.now(opcua_access.datetime.timezone.utc)
    usage = dict.fromkeys(
        ["key_agreement", "crl_sign", "encipher_only", "decipher_only", "key_cert_sign"], False
    ) | dict.fromkeys(["digital_signature", "content_commitment", "key_encipherment", "data_encipherment"], True)
    builder = (
        x509.CertificateBuilder()
        .subject_name(request.subject)
        .issuer_name(own.subject)
        .public_key(request.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - opcua_access.DAY)
        .not_valid_after(now + 30 * opcua_access.DAY)
        .add_extension(names, critical=False)
        .add_extension(x509.KeyUsage(**usage), critical=False)
    )
    return builder.sign(key, hashes.SHA256()).public_bytes(serialization.Encoding.DER)


def client_of(args):
    return Client(args.endpoint, timeout=20)


async def secured(args, name):
    folder = pathlib.Path(args.folder)
    client = client_of(args)
    client.application_uri = opcua_session.APPLICATION_URI
    security, mode = next(opcua_access.ways(args.way))
    await client.set_security(
        opcua_session.POLICIES[security],
        certificate=str(folder / f"{name}_certificate.der"),
        private_key=str(folder / f"{name}_key.pem"),
        mode=ua.MessageSecurityMode[mode],
    )
    if args.user:
        client.set_user(args.user)
        client.set_password(args.password)
    return client


async def push(args, server, said):
    folder = pathlib.Path(args.folder)
    null, none = ua.NodeId(), ua.Variant([], ua.VariantType.ByteString, is_array=True)
    before = await server.trusted()
    said["trusted_before"] = len(before.TrustedCertificates)
    said["short_nonce"] = await outcome(server.call("CreateSigningRequest", null, null, "", True, b"short"))
    request = x509.load_der_x509_csr(
        await server.call("CreateSigningRequest", null, null, "CN=Cell server,O=Plant", True, os.urandom(32))
    )
    names = request.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    said["request"] = {
        "signed": request.is_signature_valid,
        "subject": request.subject.rfc4514_string(),
        "uri": names.get_values_for_type(x509.UniformResourceIdentifier),
    }
    authority = opcua_access.authority(folder, "authority")
    opcua_access.revocations(folder, "authority.crl", authority, [])
    own = authority[1].public_bytes(serialization.Encoding.DER)
    issued = certificate_for(request, authority)
    (folder / "server.der").write_bytes(issued)
    wrong = certificate_for(request, authority, "urn:other")
    said["wrong_uri"] = await outcome(server.call("UpdateCertificate", null, null, wrong, none, "", b""))
    foreign = (folder / "client_certificate.der").read_bytes()
    said["foreign"] = await outcome(server.call("UpdateCertificate", null, null, foreign, none, "", b""))
    forged = issued[:-1] + bytes([issued[-1] ^ 1])
    said["forged"] = await outcome(server.call("UpdateCertificate", null, null, forged, [own], "", b""))
    said["unknown_authority"] = await outcome(server.call("UpdateCertificate", null, null, issued, none, "", b""))
    said["waits"] = await server.call("UpdateCertificate", null, null, issued, [own], "", b"")
    trusted = ua.TrustListDataType()
    trusted.SpecifiedLists = ua.TrustListMasks.All
    trusted.TrustedCertificates = [(folder / "client_certificate.der").read_bytes(), own]
    trusted.TrustedCrls = [(folder / "authority.crl").read_bytes()]
    trusted.IssuerCertificates = []
    trusted.IssuerCrls = []
    said["later"] = await server.trust(trusted)
    after = await server.trusted()
    said["trusted_after"] = [len(after.TrustedCertificates), len(after.TrustedCrls)]
    refused = await server.call("GetRejectedList")
    stranger = (folder / "user_certificate.der").read_bytes()
    said["rejected"] = stranger in refused
    said["added"] = await outcome(server.file("AddCertificate", stranger, True))
    thumbprint = x509.load_der_x509_certificate(stranger).fingerprint(hashes.SHA1()).hex().upper()
    said["removed"] = await outcome(server.file("RemoveCertificate", thumbprint, True))
    said["removed_again"] = await outcome(server.file("RemoveCertificate", thumbprint, True))
    opcua_access.make(folder, "issued", opcua_session.APPLICATION_URI, -1, 30, authority)
    await server.call("ApplyChanges")


async def refused(server, said):
    null = ua.NodeId()
    said["request"] = await outcome(server.call("CreateSigningRequest", null, null, "", False, b""))
    said["apply"] = await outcome(server.call("ApplyChanges"))
    said["open"] = await outcome(server.trusted())


async def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("verb", choices=["push", "refused", "shown"])
    parser.add_argument("endpoint")
    parser.add_argument("folder")
    parser.add_argument("--client", default="client")
    parser.add_argument("--way", default="Basic256Sha256/SignAndEncrypt")
    parser.add_argument("--user")
    parser.add_argument("--password")
    args = parser.parse_args()
    lifetime.bound(120.0)
    folder = pathlib.Path(args.folder)
    if args.verb == "shown":
        # Check the certificate that the server shows to every client, and that a client with a
        # certificate of the authority is accepted.
        endpoints = await client_of(args).connect_and_get_server_endpoints()
        shown = next(one.ServerCertificate for one in endpoints if one.ServerCertificate)
        said = {"new": shown == (folder / "server.der").read_bytes()}
        async with await secured(args, "issued") as client:
            said["state"] = await client.get_node(node_id("Server_ServerStatus_State")).read_value()
        lifetime.say(**said)
        return
    said = {}
    async with await secured(args, args.client) as client:
        server = Server(client)
        if args.verb == "push":
            await push(args, server, said)
        else:
            await refused(server, said)
    lifetime.say(**said)


if __name__ == "__main__":
    asyncio.run(main())
