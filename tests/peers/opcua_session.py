"""How the OPC UA peers connect, and how they write down what they see."""

import base64
import datetime
import pathlib
import socket

from asyncua import Client, ua
from asyncua.crypto.cert_gen import setup_self_signed_certificate
from asyncua.crypto.security_policies import SecurityPolicyBasic256Sha256
from cryptography.x509.oid import ExtendedKeyUsageOID

APPLICATION_URI = "urn:ua-bridge:system-tests:client"


def add_arguments(parser):
    parser.add_argument("endpoint")
    parser.add_argument("--security", choices=["None", "Basic256Sha256"], default="None")
    parser.add_argument("--certificates", help="folder for this client's key and certificate")
    parser.add_argument("--limit", type=float, default=60.0)
    parser.add_argument("--patience", type=float, default=10.0, help="how long an answer is waited for")


async def client_of(args):
    """A client that is not connected yet: `async with await client_of(args) as client`."""
    client = Client(args.endpoint, timeout=args.patience)
    if args.security == "None":
        return client
    folder = pathlib.Path(args.certificates)
    folder.mkdir(parents=True, exist_ok=True)
    key, certificate = folder / "client_key.pem", folder / "client_certificate.der"
    await setup_self_signed_certificate(
        key,
        certificate,
        APPLICATION_URI,
        socket.gethostname(),
        [ExtendedKeyUsageOID.CLIENT_AUTH],
        {"countryName": "XX", "organizationName": "system-tests"},
    )
    client.application_uri = APPLICATION_URI
    await client.set_security(
        SecurityPolicyBasic256Sha256,
        certificate=str(certificate),
        private_key=str(key),
        mode=ua.MessageSecurityMode.SignAndEncrypt,
    )
    return client


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
    """What a DataValue says, as a JSON object."""
    variant = data.Value
    # The lower half has bits about the value's way, such as that of a queue that overflowed, and is no part of the name.
    code = data.StatusCode.value & 0xFFFF0000 if data.StatusCode is not None else 0
    return {
        "node": node,
        "value": plain(variant.Value) if variant is not None else None,
        "type": variant.VariantType.name if variant is not None else None,
        "status": ua.StatusCode(code).name,
        "source_timestamp": plain(data.SourceTimestamp),
        "server_timestamp": plain(data.ServerTimestamp),
    }
