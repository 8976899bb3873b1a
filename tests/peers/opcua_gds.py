#!/usr/bin/env python3
"""Runs asyncua as a client of a Global Discovery Server.

It registers applications and has certificates issued, as a user or as an application.
"""

import argparse
import asyncio
import pathlib
import sys
from datetime import datetime, timedelta, timezone

from asyncua import Client, ua
from asyncua.ua.ua_binary import struct_from_binary
from asyncua.ua.uaerrors import UaStatusCodeError
from asyncua.common.utils import Buffer
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import rsa, padding
from cryptography.x509.oid import AttributeOID, NameOID

import lifetime
import opcua_access
import opcua_session

URI = "urn:ua-bridge:system-tests:robot"
GDS = "http://opcfoundation.org/UA/GDS/"
DIRECTORY, GROUP, TRUST_LIST = 141, 615, 616


class Gds:
    """Accesses the Directory by the ids of its NodeSet."""

    def __init__(self, client, index):
        self.client, self.index = client, index
        self.directory = self.node(DIRECTORY)

    def node(self, number):
        return self.client.get_node(ua.NodeId(number, self.index))

    async def call(self, number, *arguments):
        return await self.directory.call_method(ua.NodeId(number, self.index), *arguments)

    async def read_list(self, node, masks=None):
        """Returns the TrustListDataType of a trust list, read as a file."""
        node = self.client.get_node(node)
        if masks is None:
            handle = await node.call_method(ua.NodeId(622, self.index), ua.Variant(1, ua.VariantType.Byte))
        else:
            handle = await node.call_method(ua.NodeId(638, self.index), ua.Variant(masks, ua.VariantType.UInt32))
        handle = ua.Variant(handle, ua.VariantType.UInt32)
        content = b""
        while True:
            part = await node.call_method(ua.NodeId(627, self.index), handle, ua.Variant(700, ua.VariantType.Int32))
            if not part:
                break
            content += part
        await node.call_method(ua.NodeId(625, self.index), handle)
        return struct_from_binary(ua.TrustListDataType, Buffer(content))


def record(uri=URI, name="Robot", number=None, capabilities=("DA",)):
    """Returns an application record, of the class that asyncua made of the server's DataType."""
    told = ua.ApplicationRecordDataType()
    if number is not None:
        told.ApplicationId = number
    told.ApplicationUri = uri
    told.ApplicationType = ua.ApplicationType.Server
    told.ApplicationNames = [ua.LocalizedText(name, "en")]
    told.ProductUri = "urn:maker"
    told.DiscoveryUrls = ["opc.tcp://robot.cell:4840"]
    told.ServerCapabilities = list(capabilities)
    return told


def signing_request(uri=URI, key=None, hosts=("robot.cell",), token=None):
    key = key or rsa.generate_private_key(public_exponent=65537, key_size=2048)
    names = [x509.UniformResourceIdentifier(uri), *(x509.DNSName(host) for host in hosts)]
    builder = (
        x509.CertificateSigningRequestBuilder()
        .subject_name(x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "Robot")]))
        .add_extension(x509.SubjectAlternativeName(names), critical=False)
    )
    if token:
        builder = builder.add_attribute(AttributeOID.CHALLENGE_PASSWORD, token.encode())
    return key, builder.sign(key, hashes.SHA256()).public_bytes(serialization.Encoding.DER)


async def outcome(awaited):
    """Returns the result of a call, or the name of its status."""
    try:
        return await awaited
    except UaStatusCodeError as refused:
        return ua.StatusCode(refused.code).name


async def connected(args):
    folder = pathlib.Path(args.folder)
    if args.way == "None":
        client = Client(args.endpoint, timeout=20)
    else:
        security, mode = next(opcua_access.ways(args.way))
        client = Client(args.endpoint, timeout=20)
        client.application_uri = args.application_uri
        await client.set_security(
            opcua_session.POLICIES[security],
            certificate=str(folder / f"{args.client}_certificate.der"),
            private_key=str(folder / f"{args.client}_key.pem"),
            mode=ua.MessageSecurityMode[mode],
        )
    if args.user:
        client.set_user(args.user)
        client.set_password(args.password)
    return client


def signed_by(certificate, authority):
    public = authority.public_key()
    public.verify(
        certificate.signature, certificate.tbs_certificate_bytes, padding.PKCS1v15(), certificate.signature_hash_algorithm
    )
    return certificate.issuer == authority.subject


async def directory(gds, said):
    """Registers, finds, changes and queries applications."""
    numbers = []
    for count in range(3):
        number = await gds.call(146, record(f"{URI}-{count}", f"Robot {count}"))
        numbers.append(number)
    said["registered"] = len({str(number) for number in numbers})
    said["again"] = await outcome(gds.call(146, record(f"{URI}-0")))
    said["unfit"] = await outcome(gds.call(146, record("")))
    found = await gds.call(143, f"{URI}-1")
    said["found"] = [one.ApplicationUri for one in found]
    said["found_names"] = [one.ApplicationNames[0].Text for one in found]
    await gds.call(200, record(f"{URI}-1", "Welder", numbers[1], ("DA", "HD")))
    got = await gds.call(216, numbers[1])
    said["updated"] = [got.ApplicationNames[0].Text, got.ServerCapabilities, got.DiscoveryUrls]
    word = lambda value: ua.Variant(value, ua.VariantType.UInt32)  # noqa: E731
    none = ua.Variant([], ua.VariantType.String, is_array=True)
    since, after, page = await gds.call(992, word(0), word(2), "", "", word(0), "", none)
    said["first_page"] = [one.ApplicationUri for one in page]
    _, after, page = await gds.call(992, word(after), word(2), "", "", word(0), "", none)
    said["second_page"] = [[one.ApplicationUri for one in page], after]
    _, _, page = await gds.call(992, word(0), word(0), "Weld%", "", word(1), "", ["hd"])
    said["filtered"] = [[one.ApplicationUri, one.DiscoveryUrls] for one in page]
    _, servers = await gds.call(151, word(0), word(0), "", f"{URI}-2", "", none)
    said["servers"] = [[one.ServerName, one.DiscoveryUrl, one.ServerCapabilities] for one in servers]
    said["since"] = since.isoformat()
    await gds.call(149, numbers[2])
    said["gone"] = await outcome(gds.call(216, numbers[2]))


async def certificates(gds, said, folder):
    """Has a certificate issued for a registered application, checks it with another library, and
    has it revoked."""
    number = await gds.call(146, record())
    groups = await gds.call(508, number)
    said["groups"] = [str(group) for group in groups]
    null = ua.NodeId()
    said["due_before"] = await gds.call(225, number, null, null)
    key, wanted = signing_request()
    said["foreign_uri"] = await outcome(gds.call(157, number, groups[0], null, signing_request("urn:other")[1]))
    said["forged"] = await outcome(gds.call(157, number, groups[0], null, wanted[:-1] + bytes([wanted[-1] ^ 1])))
    request = await gds.call(157, number, groups[0], null, wanted)
    issued, private, issuers = await gds.call(163, number, request)
    again, _, _ = await gds.call(163, number, request)
    said["twice"] = again == issued
    certificate, authority = x509.load_der_x509_certificate(issued), x509.load_der_x509_certificate(issuers[0])
    names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    said["issued"] = {
        "signed": signed_by(certificate, authority),
        "uri": names.get_values_for_type(x509.UniformResourceIdentifier),
        "hosts": names.get_values_for_type(x509.DNSName),
        "own_key": certificate.public_key().public_numbers() == key.public_key().public_numbers(),
        "no_private_key": not private,
        "is_authority": certificate.extensions.get_extension_for_class(x509.BasicConstraints).value.ca,
    }
    (folder / "robot_certificate.der").write_bytes(issued)
    pem = key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    (folder / "robot_key.pem").write_bytes(pem)
    said["due_after"] = await gds.call(225, number, groups[0], null)
    _, own = await gds.call(174, number, groups[0])
    said["kept"] = [one == issued for one in own]
    pair = await gds.call(
        154, number, groups[0], null, "CN=Paired,O=Plant", ["robot.cell", "192.0.2.9"], "PEM", ""
    )
    made, private, _ = await gds.call(163, number, pair)
    made = x509.load_der_x509_certificate(made)
    loaded = serialization.load_pem_private_key(private, None)
    said["pair"] = [
        made.subject.get_attributes_for_oid(NameOID.COMMON_NAME)[0].value,
        loaded.public_key().public_numbers() == made.public_key().public_numbers(),
    ]
    where = await gds.call(204, number, groups[0])
    trusted = await gds.read_list(where)
    said["trust_list"] = [
        trusted.SpecifiedLists,
        [x509.load_der_x509_certificate(one).subject == authority.subject for one in trusted.TrustedCertificates],
        [x509.load_der_x509_crl(one).is_signature_valid(authority.public_key()) for one in trusted.TrustedCrls],
    ]
    masked = await gds.read_list(where, 1)
    said["masked"] = [masked.SpecifiedLists, len(masked.TrustedCertificates), masked.TrustedCrls or []]
    status, _ = await gds.call(177, issued)
    said["status"] = status.name if hasattr(status, "name") else ua.StatusCode(status).name
    await gds.call(15005, number, made.public_bytes(serialization.Encoding.DER))
    trusted = await gds.read_list(where)
    crl = x509.load_der_x509_crl(trusted.TrustedCrls[0])
    said["revoked"] = [
        crl.get_revoked_certificate_by_serial_number(made.serial_number) is not None,
        crl.get_revoked_certificate_by_serial_number(certificate.serial_number) is not None,
    ]
    status, until = await gds.call(177, made.public_bytes(serialization.Encoding.DER))
    said["status_revoked"] = status.name if hasattr(status, "name") else ua.StatusCode(status).name
    ahead = until.replace(tzinfo=timezone.utc) - datetime.now(timezone.utc)
    said["list_lives"] = timedelta(days=10) < ahead < timedelta(days=31)


async def itself(gds, said):
    """Checks an application with its own certificate: it may act for itself only."""
    found = await gds.call(143, URI)
    number = found[0].ApplicationId
    _, wanted = signing_request()
    request = await gds.call(157, number, ua.NodeId(), ua.NodeId(), wanted)
    issued, _, _ = await gds.call(163, number, request)
    said["renewed"] = x509.load_der_x509_certificate(issued).not_valid_after_utc.isoformat()
    said["other"] = await outcome(gds.call(146, record("urn:other")))
    elsewhere = signing_request(hosts=["robot.cell", "other.cell"])[1]
    said["other_host"] = await outcome(gds.call(157, number, ua.NodeId(), ua.NodeId(), elsewhere))
    trusted = await gds.read_list(await gds.call(204, number, ua.NodeId()))
    said["trusted"] = len(trusted.TrustedCertificates)


async def stranger(gds, said):
    """Checks a user that may only read."""
    said["register"] = await outcome(gds.call(146, record("urn:stranger")))
    said["found"] = await outcome(gds.call(143, "urn:nobody"))
    said["start"] = await outcome(
        gds.call(157, ua.NodeId(1, 1), ua.NodeId(), ua.NodeId(), signing_request()[1])
    )
    handle = gds.node(TRUST_LIST).call_method(ua.NodeId(622, gds.index), ua.Variant(1, ua.VariantType.Byte))
    said["open"] = await outcome(handle)


async def applies(gds, said, args, folder):
    """Requests the first certificate of an untrusted application, with a token or without."""
    uri = args.application_uri
    null = ua.NodeId()
    number = await outcome(gds.call(146, record(uri)))
    key = serialization.load_pem_private_key((folder / f"{args.client}_key.pem").read_bytes(), None)
    wanted = signing_request(uri, key, token=args.token)[1]
    other = signing_request(uri)[1]
    said["other_key"] = await outcome(gds.call(157, number, null, null, other))
    request = await outcome(gds.call(157, number, null, null, wanted))
    if isinstance(request, str):
        said["started"] = request
        return
    said["started"] = "Good"
    answer = await outcome(gds.call(163, number, request))
    if isinstance(answer, str):
        said["finished"] = answer
        handle = gds.node(TRUST_LIST).call_method(ua.NodeId(622, gds.index), ua.Variant(1, ua.VariantType.Byte))
        said["open"] = await outcome(handle)
        return
    issued, _, issuers = answer
    again, _, _ = await gds.call(163, number, request)
    certificate = x509.load_der_x509_certificate(issued)
    said["finished"] = "Good"
    said["twice"] = again == issued
    said["own_key"] = certificate.public_key().public_numbers() == key.public_key().public_numbers()
    said["signed"] = signed_by(certificate, x509.load_der_x509_certificate(issuers[0]))
    registered = (await gds.call(143, uri))[0].ApplicationId
    trusted = await gds.read_list(await gds.call(204, registered, null))
    said["trusted"] = [one == issuers[0] for one in trusted.TrustedCertificates]


async def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("verb", choices=["make", "directory", "certificates", "itself", "stranger", "applies"])
    parser.add_argument("endpoint")
    parser.add_argument("folder")
    parser.add_argument("--client", default="client")
    parser.add_argument("--application-uri", default=opcua_session.APPLICATION_URI)
    parser.add_argument("--way", default="Basic256Sha256/SignAndEncrypt")
    parser.add_argument("--user")
    parser.add_argument("--password")
    parser.add_argument("--token")
    args = parser.parse_args()
    lifetime.bound(120.0)
    folder = pathlib.Path(args.folder)
    if args.verb == "make":
        opcua_access.make(folder, args.client, args.application_uri, -1, 365)
        lifetime.say(made=True)
        return
    said = {}
    client = await connected(args)
    try:
        await client.connect()
    except Exception as refused:  # any failure is the outcome
        lifetime.say(connected=opcua_access.status_of(refused) or repr(refused))
        return
    async with client:
        await client.load_data_type_definitions()
        gds = Gds(client, await client.get_namespace_index(GDS))
        if args.verb == "directory":
            await directory(gds, said)
        elif args.verb == "certificates":
            await certificates(gds, said, folder)
        elif args.verb == "applies":
            await applies(gds, said, args, folder)
        elif args.verb == "itself":
            await itself(gds, said)
        else:
            await stranger(gds, said)
    lifetime.say(connected="Good", **said)


if __name__ == "__main__":
    asyncio.run(main())
    sys.exit(0)
