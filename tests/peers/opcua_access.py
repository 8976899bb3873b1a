"""Checks the access to an OPC UA server and the permissions there: a JSON line for each try.

- `pairs FOLDER` makes the keys and certificates for the tries: of a client (`client`), of a client
  with an expired certificate (`expired`), of a user (`user`), and of a server that the peers can be
  (`server`).
- `issued FOLDER` makes authorities, certificates that they issue, and their revocation lists.
- `servers FOLDER` makes certificates of servers, of which exactly one is valid.
- `tries URL FOLDER NODE TYPE VALUE USER PASSWORD` tries each security policy and mode with each
  kind of user, and reads and writes the node.
- `endpoints URL` prints the policies that a server offers.
- `audit URL` prints the events of the Server object.
- `crowd URL COUNT` opens COUNT sessions at once and prints how many succeed. With `--vanish` each
  session has a subscription, and its connection breaks off like the connection of a killed client.
"""

import argparse
import asyncio
import datetime
import ipaddress
import logging
import os
import pathlib
import socket

from asyncua import Client, ua
from asyncua.ua.uaerrors import UaStatusCodeError
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import rsa
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

import lifetime
import opcua_session

DAY = datetime.timedelta(days=1)


def make(folder, name, uri, begin, end, above=None, purpose=ExtendedKeyUsageOID.CLIENT_AUTH, host="127.0.0.1"):
    """Makes a key and a certificate of an application, valid between two days relative to today:
    self-signed, or issued by an authority."""
    key = rsa.generate_private_key(public_exponent=65537, key_size=2048)
    subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
    now = datetime.datetime.now(datetime.timezone.utc)
    usage = dict.fromkeys(["key_agreement", "crl_sign", "encipher_only", "decipher_only"], False)
    usage |= dict.fromkeys(
        ["digital_signature", "content_commitment", "key_encipherment", "data_encipherment", "key_cert_sign"], True
    )
    names = [
        x509.UniformResourceIdentifier(uri),
        x509.DNSName(socket.gethostname()),
        x509.IPAddress(ipaddress.ip_address(host)),
    ]
    builder = (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(above[1].subject if above else subject)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now + begin * DAY)
        .not_valid_after(now + end * DAY)
        .add_extension(x509.SubjectAlternativeName(names), critical=False)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=False)
        .add_extension(x509.KeyUsage(**usage), critical=False)
        .add_extension(x509.ExtendedKeyUsage([purpose]), critical=False)
    )
    certificate = builder.sign(above[0] if above else key, hashes.SHA256())
    folder.mkdir(parents=True, exist_ok=True)
    pem = key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    (folder / f"{name}_key.pem").write_bytes(pem)
    (folder / f"{name}_certificate.der").write_bytes(certificate.public_bytes(serialization.Encoding.DER))
    return certificate


def authority(folder, name, above=None, end=365):
    """Makes the key and the certificate of an authority, which another authority may issue."""
    key = rsa.generate_private_key(public_exponent=65537, key_size=2048)
    subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
    issuer, signs = (above[1].subject, above[0]) if above else (subject, key)
    now = datetime.datetime.now(datetime.timezone.utc)
    usage = dict.fromkeys(
        ["content_commitment", "key_encipherment", "data_encipherment", "key_agreement", "encipher_only", "decipher_only"],
        False,
    ) | dict.fromkeys(["digital_signature", "key_cert_sign", "crl_sign"], True)
    builder = (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - 30 * DAY)
        .not_valid_after(now + end * DAY)
        .add_extension(x509.BasicConstraints(ca=True, path_length=None), critical=True)
        .add_extension(x509.KeyUsage(**usage), critical=True)
    )
    certificate = builder.sign(signs, hashes.SHA256())
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{name}.der").write_bytes(certificate.public_bytes(serialization.Encoding.DER))
    return key, certificate


def revocations(folder, name, of, revoked, end=30):
    """Makes the revocation list of an authority."""
    now = datetime.datetime.now(datetime.timezone.utc)
    builder = (
        x509.CertificateRevocationListBuilder()
        .issuer_name(of[1].subject)
        .last_update(now - 20 * DAY if end < 0 else now - datetime.timedelta(seconds=5))
        .next_update(now + end * DAY)
    )
    for one in revoked:
        builder = builder.add_revoked_certificate(
            x509.RevokedCertificateBuilder().serial_number(one.serial_number).revocation_date(now).build()
        )
    made = builder.sign(of[0], hashes.SHA256())
    (folder / name).write_bytes(made.public_bytes(serialization.Encoding.DER))


def issued(folder):
    uri = opcua_session.APPLICATION_URI
    plant = authority(folder, "plant")
    between = authority(folder, "between", plant)
    over = authority(folder, "over", end=-1)
    client = make(folder, "client", uri, -1, 365, plant)
    make(folder, "late", uri, -30, -1, plant)
    gone = make(folder, "gone", uri, -1, 365, plant)
    make(folder, "below", uri, -1, 365, between)
    make(folder, "orphan", uri, -1, 365, over)
    make(folder, "stranger", uri, -1, 365, authority(folder, "strange"))
    revocations(folder, "plant.crl", plant, [gone])
    revocations(folder, "plant-old.crl", plant, [], -1)
    revocations(folder, "plant-all.crl", plant, [gone, between[1]])
    revocations(folder, "plant-now.crl", plant, [gone, client])
    revocations(folder, "between.crl", between, [])
    revocations(folder, "over.crl", over, [])
    lifetime.say(made=str(folder))


def servers(folder, host):
    uri, purpose = opcua_session.SERVER_URI, ExtendedKeyUsageOID.SERVER_AUTH
    plant = authority(folder, "plant")
    sound = make(folder, "sound", uri, -1, 365, plant, purpose, host)
    gone = make(folder, "gone", uri, -1, 365, plant, purpose, host)
    make(folder, "late", uri, -30, -1, plant, purpose, host)
    make(folder, "elsewhere", uri, -1, 365, plant, purpose, "192.0.2.7")
    make(folder, "impostor", f"{uri}:another", -1, 365, plant, purpose, host)
    make(folder, "stranger", f"{uri}:another", -1, 365, authority(folder, "strange"), purpose, host)
    make(folder, "client", opcua_session.APPLICATION_URI, -1, 365, plant)
    revocations(folder, "plant.crl", plant, [gone])
    revocations(folder, "plant-now.crl", plant, [gone, sound])
    lifetime.say(made=str(folder))


def pairs(folder):
    make(folder, "client", opcua_session.APPLICATION_URI, -1, 365)
    make(folder, "expired", opcua_session.APPLICATION_URI, -30, -1)
    make(folder, "user", "urn:ua-bridge:system-tests:user", -1, 365)
    make(folder, "old", "urn:ua-bridge:system-tests:user", -30, -1)
    make(folder, "server", opcua_session.SERVER_URI, -1, 365, purpose=ExtendedKeyUsageOID.SERVER_AUTH)
    lifetime.say(made=str(folder))


def aged(folder, uri):
    make(folder, "aged", uri, -9, 1, purpose=ExtendedKeyUsageOID.SERVER_AUTH)
    lifetime.say(made=str(folder))


def status_of(error):
    """Returns the name of the status in an error, however it is wrapped."""
    while error is not None:
        if isinstance(error, UaStatusCodeError):
            return ua.StatusCode(error.code).name
        error = error.__cause__ or error.__context__
    return None


class Refusals(logging.Handler):
    """Keeps the error that ends a connection: the client logs it and raises another error."""

    def __init__(self):
        super().__init__()
        self.last = None
        logging.getLogger("asyncua").addHandler(self)

    def emit(self, record):
        for one in record.args if isinstance(record.args, tuple) else ():
            if isinstance(one, ua.ErrorMessage):
                self.last = ua.StatusCode(one.Error.value).name


async def tried(args, client, about):
    """Connects, reads and writes, and prints the status of each."""
    said = dict(about)
    refusals = Refusals()
    try:
        async with client:
            said["connected"] = "Good"
            node = client.get_node(args.node)
            try:
                data = await node.read_data_value(raise_on_bad_status=False)
                said["read"] = ua.StatusCode(data.StatusCode.value & 0xFFFF0000).name
                variant = ua.Variant(float(args.value), ua.VariantType[args.type])
                await node.write_value(ua.DataValue(variant))
                said["write"] = "Good"
            except UaStatusCodeError as refused:
                said.setdefault("read", status_of(refused))
                said.setdefault("write", status_of(refused))
    except Exception as error:  # any failure is the outcome
        if "connected" not in said:
            said["connected"] = refusals.last or status_of(error) or repr(error)
    lifetime.say(**said)


async def secured(args, name, security, mode):
    folder = pathlib.Path(args.folder)
    client = Client(args.endpoint, timeout=20)
    client.application_uri = args.application_uri
    if security == "None":
        return client
    await client.set_security(
        opcua_session.POLICIES[security],
        certificate=str(folder / f"{name}_certificate.der"),
        private_key=str(folder / f"{name}_key.pem"),
        mode=ua.MessageSecurityMode[mode],
    )
    client.application_uri = args.application_uri
    return client


async def as_user(args, client, user):
    if user in ("password", "wrong", "nobody"):
        client.set_user("nobody" if user == "nobody" else args.user)
        client.set_password("another one" if user == "wrong" else args.password)
    if user in ("certificate", "old"):
        name = "user" if user == "certificate" else "old"
        folder = pathlib.Path(args.folder)
        await client.load_client_certificate(str(folder / f"{name}_certificate.der"))
        await client.load_private_key(str(folder / f"{name}_key.pem"))


async def tries(args):
    for security, mode in args.with_security:
        for user in args.users.split(","):
            client = await secured(args, args.client, security, mode)
            await as_user(args, client, user)
            await tried(args, client, {"security": security, "mode": mode, "user": user})


async def endpoints(url):
    found = await Client(url, timeout=10).connect_and_get_server_endpoints()
    policies = [one.SecurityPolicyUri.rpartition("#")[2] for one in found]
    issuers = [issuer(one.ServerCertificate) for one in found if one.ServerCertificate]
    lifetime.say(policies=policies, urls=[one.EndpointUrl for one in found], issuers=issuers)


def issuer(der):
    """Returns the common name of the issuer of a certificate."""
    names = x509.load_der_x509_certificate(der).issuer.get_attributes_for_oid(NameOID.COMMON_NAME)
    return names[0].value if names else None


FIELDS = ["EventType", "SourceName", "Status", "StatusCodeId", "ClientUserId", "ServerId", "NewValue", "OldValue", "MethodId"]
NUMBERS = {
    getattr(ua.ObjectIds, name): name
    for name in ("AuditActivateSessionEventType", "AuditWriteUpdateEventType", "AuditUpdateMethodEventType")
}


class Audited:
    def event_notification(self, event):
        said = event.get_event_props_as_fields_dict()
        plain = {name: opcua_session.plain(said[name].Value) for name in FIELDS}
        plain["EventType"] = NUMBERS.get(said["EventType"].Value.Identifier, str(said["EventType"].Value))
        for name in ("MethodId", "StatusCodeId"):
            plain[name] = str(said[name].Value)
        lifetime.say(**plain)


async def audit(url):
    async with Client(url, timeout=10) as client:
        selects = [
            ua.SimpleAttributeOperand(
                TypeDefinitionId=ua.NodeId(ua.ObjectIds.BaseEventType),
                BrowsePath=[ua.QualifiedName(name)],
                AttributeId=ua.AttributeIds.Value,
            )
            for name in FIELDS
        ]
        subscription = await client.create_subscription(50, Audited())
        await subscription.subscribe_events(evfilter=ua.EventFilter(SelectClauses=selects), queuesize=100)
        lifetime.say(ready=True)
        await asyncio.Event().wait()


class Nobody:
    def datachange_notification(self, _node, _value, _data):
        pass


async def crowd(args):
    """Prints how many clients connected, and the errors of the others."""

    async def come():
        client = Client(args.endpoint, timeout=20)
        client.session_timeout = 2_000 if args.vanish else 60_000
        try:
            await client.connect()
            return client, "Good"
        except Exception as error:  # any failure is the outcome
            return client, status_of(error) or repr(error)

    came = await asyncio.gather(*(come() for _ in range(args.count)))
    said = {}
    for _, outcome in came:
        said[outcome] = said.get(outcome, 0) + 1
    there = [client for client, outcome in came if outcome == "Good"]
    if args.vanish:
        for client in there:
            subscription = await client.create_subscription(20, Nobody())
            await subscription.subscribe_data_change(client.get_node(ua.NodeId(ua.ObjectIds.Server_ServerStatus_CurrentTime)))
        lifetime.say(**said)
        for client in there:
            client.uaclient.protocol.transport.abort()
        os._exit(0)
    await asyncio.gather(*(client.disconnect() for client in there))
    lifetime.say(**said)


async def hold(args):
    """Holds a session until the connection is cut off."""
    security, mode = args.with_security[0]
    client = await secured(args, args.client, security, mode)
    await client.connect()
    lifetime.say(ready=True)
    try:
        while True:
            await client.get_node(ua.NodeId(ua.ObjectIds.Server_ServerStatus_CurrentTime)).read_value()
            await asyncio.sleep(0.2)
    except Exception as error:  # any failure is the loss of the connection
        lifetime.say(cut_off=repr(error))
        os._exit(0)


def ways(text):
    """Reads pairs of policy and mode, such as `None,Basic256Sha256/Sign`."""
    for one in text.split(","):
        security, _, mode = one.partition("/")
        yield security, mode or "None"


def main():
    parser = argparse.ArgumentParser()
    verbs = parser.add_subparsers(dest="verb", required=True)
    making = verbs.add_parser("pairs")
    making.add_argument("folder", type=pathlib.Path)
    aging = verbs.add_parser("aged")
    aging.add_argument("folder", type=pathlib.Path)
    aging.add_argument("uri")
    issuing = verbs.add_parser("issued")
    issuing.add_argument("folder", type=pathlib.Path)
    serving = verbs.add_parser("servers")
    serving.add_argument("folder", type=pathlib.Path)
    serving.add_argument("--host", default="127.0.0.1", help="the address they are reached at")
    trying = verbs.add_parser("tries")
    trying.add_argument("endpoint")
    trying.add_argument("folder")
    trying.add_argument("node")
    trying.add_argument("type")
    trying.add_argument("value")
    trying.add_argument("--client", default="client", help="whose pair the application has")
    trying.add_argument("--application-uri", default=opcua_session.APPLICATION_URI)
    trying.add_argument("--ways", dest="with_security", type=lambda text: list(ways(text)), required=True)
    trying.add_argument("--users", default="anonymous")
    trying.add_argument("--user")
    trying.add_argument("--password")
    holding = verbs.add_parser("hold")
    holding.add_argument("endpoint")
    holding.add_argument("folder")
    holding.add_argument("--client", default="client")
    holding.add_argument("--application-uri", default=opcua_session.APPLICATION_URI)
    holding.add_argument("--ways", dest="with_security", type=lambda text: list(ways(text)), required=True)
    telling = verbs.add_parser("endpoints")
    telling.add_argument("endpoint")
    auditing = verbs.add_parser("audit")
    auditing.add_argument("endpoint")
    crowding = verbs.add_parser("crowd")
    crowding.add_argument("endpoint")
    crowding.add_argument("count", type=int)
    crowding.add_argument("--vanish", action="store_true")
    args = parser.parse_args()
    lifetime.bound(120.0)
    if args.verb == "pairs":
        pairs(args.folder)
    elif args.verb == "aged":
        aged(args.folder, args.uri)
    elif args.verb == "issued":
        issued(args.folder)
    elif args.verb == "servers":
        servers(args.folder, args.host)
    elif args.verb == "endpoints":
        asyncio.run(endpoints(args.endpoint))
    elif args.verb == "audit":
        asyncio.run(audit(args.endpoint))
    elif args.verb == "hold":
        asyncio.run(hold(args))
    elif args.verb == "crowd":
        asyncio.run(crowd(args))
    else:
        asyncio.run(tries(args))


if __name__ == "__main__":
    main()
