"""Provides the connections of the OPC UA peers, and the JSON form of values."""

import base64
import datetime
import pathlib
import socket

from asyncua import Client, ua
from asyncua.crypto.cert_gen import setup_self_signed_certificate
from asyncua.crypto.security_policies import (
    SecurityPolicyAes128Sha256RsaOaep,
    SecurityPolicyAes256Sha256RsaPss,
    SecurityPolicyBasic256Sha256,
)
from cryptography.x509.oid import ExtendedKeyUsageOID

APPLICATION_URI = "urn:ua-bridge:system-tests:client"
SERVER_URI = "urn:ua-bridge:system-tests:plc"
POLICIES = {
    "Basic256Sha256": SecurityPolicyBasic256Sha256,
    "Aes128_Sha256_RsaOaep": SecurityPolicyAes128Sha256RsaOaep,
    "Aes256_Sha256_RsaPss": SecurityPolicyAes256Sha256RsaPss,
}


def add_arguments(parser):
    parser.add_argument("endpoint")
    parser.add_argument("--security", choices=["None", *POLICIES], default="None")
    parser.add_argument("--mode", choices=["Sign", "SignAndEncrypt"], default="SignAndEncrypt")
    parser.add_argument("--certificates", help="folder for this client's key and certificate")
    parser.add_argument("--application-uri", default=APPLICATION_URI, help="what the client says it is")
    parser.add_argument("--user", help="the name of a user")
    parser.add_argument("--password")
    parser.add_argument("--user-certificate", help="folder for the key and certificate of a user")
    parser.add_argument("--limit", type=float, default=60.0)
    parser.add_argument("--patience", type=float, default=10.0, help="how long an answer is waited for")


async def pair_of(folder, name, uri):
    """Returns the key and the certificate in a folder, and makes them if they do not exist."""
    folder = pathlib.Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    key, certificate = folder / f"{name}_key.pem", folder / f"{name}_certificate.der"
    await setup_self_signed_certificate(
        key,
        certificate,
        uri,
        socket.gethostname(),
        [ExtendedKeyUsageOID.CLIENT_AUTH],
        {"countryName": "XX", "organizationName": "system-tests", "commonName": name},
    )
    return str(key), str(certificate)


async def client_of(args):
    """Returns a client that is not connected yet: `async with await client_of(args) as client`."""
    client = Client(args.endpoint, timeout=args.patience)
    if args.user:
        client.set_user(args.user)
        client.set_password(args.password)
    if args.user_certificate:
        key, certificate = await pair_of(args.user_certificate, "user", "urn:ua-bridge:system-tests:user")
        await client.load_client_certificate(certificate)
        await client.load_private_key(key)
    if args.security == "None":
        return client
    key, certificate = await pair_of(args.certificates, "client", APPLICATION_URI)
    client.application_uri = args.application_uri
    await client.set_security(
        POLICIES[args.security],
        certificate=certificate,
        private_key=key,
        mode=ua.MessageSecurityMode[args.mode],
    )
    return client


async def secure(server, folder, only=None, pair="server", uri=SERVER_URI):
    """Makes a server offer no security and each known policy, or only one policy, with a pair of
    `opcua_access.py` in the folder."""
    folder = pathlib.Path(folder)
    await server.load_certificate(str(folder / f"{pair}_certificate.der"))
    await server.load_private_key(str(folder / f"{pair}_key.pem"))
    await server.set_application_uri(uri)
    offered = [only] if only else ["None", *POLICIES]
    types = ua.SecurityPolicyType
    named = {name: types[f"{name.replace('_', '')}_SignAndEncrypt"] for name in POLICIES}
    server.set_security_policy([types.NoSecurity if name == "None" else named[name] for name in offered])


def plain(value):
    if isinstance(value, (bytes, bytearray)):
        return base64.b64encode(value).decode("ascii")
    if isinstance(value, datetime.datetime):
        return value.isoformat()
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    return str(value)


def described(node, data):
    """Returns a DataValue as a JSON object."""
    variant = data.Value
    # The lower half has bits about the transport of the value, such as an overflow of a queue, and
    # is not part of the name.
    code = data.StatusCode.value & 0xFFFF0000 if data.StatusCode is not None else 0
    return {
        "node": node,
        "value": plain(variant.Value) if variant is not None else None,
        "type": variant.VariantType.name if variant is not None else None,
        "status": ua.StatusCode(code).name,
        "source_timestamp": plain(data.SourceTimestamp),
        "server_timestamp": plain(data.ServerTimestamp),
    }
