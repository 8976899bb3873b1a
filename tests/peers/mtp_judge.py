"""Counts and joins the elements of manifests with lxml, which shares no code with our reader.

    mtp_judge.py MANIFEST ...

Each manifest gets a JSON line.
"""

import sys

from lxml import etree

import lifetime

SENSORS = {"AnaView", "BinView", "DIntView", "StringView", "StrView", "AnaMon", "BinMon", "DIntMon"}
ACTUATORS = {"AnaVlv", "BinVlv", "AnaDrv", "BinDrv", "PIDCtrl"}
PROCEDURES = {"Procedure", "ServiceProcedure", "ServiceStrategy"}
PARAMETERS = {"ConfigurationParameter", "ProcedureParameter", "StrategyParameter"}
OUTPUTS = {"ReportValue", "ProcessValueOut"}
PARTS = (["VisualObject"], ["TopologyObject"], ["Connection"])
LINES = {"Pipe", "MeasurementLine", "FunctionLine"}
LIBRARIES = {"InterfaceClassLib", "SystemUnitClassLib", "RoleClassLib", "AttributeTypeLib"}


def local(element):
    return element.tag.split("}")[-1] if isinstance(element.tag, str) else ""


def path(element):
    return element.get("RefBaseSystemUnitPath") or element.get("RefBaseClassPath") or ""


def kind(element):
    return path(element).split("/")[-1]


def attributes(element):
    """Returns the attributes with a value, by their names; the last of a name counts."""
    found = {}
    for child in element:
        if local(child) == "Attribute":
            for value in child:
                if local(value) == "Value" and (value.text or "").strip():
                    found[child.get("Name")] = value.text.strip()
    return found


def first(values, *names):
    return next((values[name] for name in names if name in values), None)


def numbers(values, *names):
    """Returns the numbers of some attributes, or `None` if one is missing."""
    found = [values.get(name) for name in names]
    return None if None in found else [float(number) for number in found]


def points(text):
    """Returns the points of an Edgepath."""
    each = [point.split(",") for point in (text or "").split(";") if point.strip()]
    return [[float(number) for number in point] for point in each]


class Manifest:
    def __init__(self, file):
        self.items = {}
        self.assemblies = []
        self.by_ref = {}
        self.services = []
        self.servers = []
        self.module = None
        self.pictures = []
        self.walk(etree.parse(file).getroot(), False, None)

    def walk(self, element, listed, endpoint):
        if local(element) in LIBRARIES:
            return
        parts = set(path(element).split("/"))
        if local(element) == "ExternalInterface" and kind(element) == "OPCUAItem":
            self.items[element.get("ID")] = (element, endpoint)
        if local(element) == "InternalElement":
            if path(element) == "MTPSUCLib/ModuleTypePackage":
                self.module = self.module or element
            if kind(element) == "OPCUAServer":
                endpoint = attributes(element).get("Endpoint", "")
                self.servers.append(element)
            if kind(element) == "Picture":
                self.pictures.append(element)
            if path(element) == "MTPServiceSUCLib/Service":
                self.services.append(element)
            library = path(element).split("/")[0]
            data = library in ("MTPDataObjectSUCLib", "MTPDataAssemblySUCLib") and "DataAssembly" in parts
            if data or (listed and path(element)):
                self.assemblies.append(element)
                self.by_ref.setdefault(element.get("ID"), element)
                for child in element:
                    if local(child) == "Attribute" and child.get("Name") == "RefID":
                        for value in child:
                            if local(value) == "Value":
                                self.by_ref[(value.text or "").strip()] = element
        inside = kind(element) == "InstanceList" or (
            not path(element) and element.get("Name") == "DataAssemblies"
        )
        for child in element:
            self.walk(child, inside, endpoint)

    def node(self, values, *names):
        """Returns the identifier of the node of the first existing variable."""
        found = self.items.get(first(values, *names) or "")
        return attributes(found[0]).get("Identifier") if found else None

    def variables(self, element):
        assembly = self.by_ref.get(attributes(element).get("RefID", ""))
        return attributes(assembly) if assembly is not None else {}

    def of_kind(self, kinds):
        return [one for one in self.assemblies if kinds & set(path(one).split("/"))]

    def service(self, service):
        control = self.variables(service)
        children = [child for child in service if local(child) == "InternalElement"]
        own = {one.get("ID"): one for one in children if kind(one) in PARAMETERS}
        required = set()
        for child in children:
            if kind(child) in PROCEDURES:
                required |= set(attributes(child).get("RequiredParameters", "").split())
        shared = [one for key, one in own.items() if key not in required]
        procedures = []
        for child in children:
            if kind(child) not in PROCEDURES:
                continue
            values = attributes(child)
            number = first(values, "ProcedureID", "ProcedureId", "StrategyID")
            inner = [one for one in child if kind(one) in PARAMETERS]
            inner += [own[key] for key in values.get("RequiredParameters", "").split() if key in own]
            outputs = [one for one in child if kind(one) in OUTPUTS]
            outputs += [one for one in children if kind(one) in OUTPUTS]
            procedures.append(
                {
                    "name": child.get("Name"),
                    "number": int(number),
                    "parameters": [self.parameter(one) for one in inner + shared],
                    "outputs": [self.output(one) for one in outputs],
                }
            )
        return {
            "name": service.get("Name"),
            "state": self.node(control, "StateCur", "CurrentState", "State"),
            "command": self.node(control, "CommandExt", "ControlExt"),
            "variables": sorted(
                name
                for name, names in [
                    ("ProcedureCur", ("ProcedureCur", "CurrentStrategy")),
                    ("ProcedureReq", ("ProcedureReq",)),
                    ("StateCur", ("StateCur", "CurrentState", "State")),
                ]
                if self.node(control, *names)
            ),
            "selection": self.node(control, "ProcedureExt", "StrategyExt"),
            "procedures": procedures,
        }

    def parameter(self, element):
        values = self.variables(element)
        limits = {}
        for name, variable in (("min", "VMin"), ("max", "VMax")):
            value = values.get(variable)
            limits[f"{name}_node"] = self.node(values, variable)
            try:
                limits[name] = None if value in self.items or value is None else float(value)
            except ValueError:
                limits[name] = None
        return {"name": element.get("Name"), "node": self.node(values, "VExt"), **limits}

    def picture(self, picture):
        """Returns the parts of a picture, and the names of the parts that each link joins."""
        inner = picture.xpath(".//*[local-name()='InternalElement']")
        parts = [one for one in inner if "PortObject" not in path(one) and self.is_part(one)]
        lines = [one for one in parts if kind(one) in LINES]
        ports = [one for one in inner if one.getparent() in parts]
        owners = {}
        for port in ports:
            owners[port.get("ID")] = port.getparent().get("Name")
            for connector in port:
                if local(connector) == "ExternalInterface":
                    owners[connector.get("ID")] = port.getparent().get("Name")
        links = []
        for link in picture.xpath(".//*[local-name()='InternalLink']"):
            sides = [link.get("RefPartnerSideA"), link.get("RefPartnerSideB")]
            ids = [side if side in owners else side.split(":")[0].strip("{}") for side in sides]
            links.append(sorted(owners[side] for side in ids))
        values = attributes(picture)
        return {
            "name": picture.get("Name"),
            "size": numbers(values, "Width", "Height"),
            "objects": [self.shown(one) for one in parts if one not in lines],
            "connections": [
                [one.get("Name"), kind(one), points(attributes(one).get("Edgepath"))]
                for one in lines
            ],
            "ports": len(ports),
            "links": sorted(links),
            "groups": len(inner) - len(parts) - len(ports),
        }

    def is_part(self, element):
        return path(element).split("/")[1:2] in PARTS

    def shown(self, element):
        """Returns an object of a picture with the name of its data assembly."""
        values = attributes(element)
        assembly = self.by_ref.get(values.get("RefID"))
        return [
            element.get("Name"),
            kind(element),
            numbers(values, "X", "Y"),
            numbers(values, "Width", "Height"),
            float(values.get("Rotation", 0)),
            values.get("eClassClassificationClass", ""),
            assembly.get("Name") if assembly is not None else None,
        ]

    def output(self, element):
        values = self.variables(element)
        node = self.node(values, "V", "VExt", "VOut", "VFbk")
        return {"name": element.get("Name"), "node": node}


def main():
    lifetime.bound(60.0)
    for file in sys.argv[1:]:
        manifest = Manifest(file)
        access = []
        for item, endpoint in manifest.items.values():
            values = attributes(item)
            access.append(
                [
                    item.get("Name"),
                    endpoint,
                    values.get("Namespace"),
                    values.get("Identifier"),
                    int(values.get("Access", 3)),
                ]
            )
        lifetime.say(
            module=manifest.module.get("Name"),
            servers=[one.get("Name") for one in manifest.servers],
            sensors=[one.get("Name") for one in manifest.of_kind(SENSORS)],
            actuators=[
                [one.get("Name"), kind(one)] for one in manifest.of_kind(ACTUATORS)
            ],
            assemblies=len(manifest.assemblies),
            access=access,
            services=[manifest.service(one) for one in manifest.services],
            pictures=[manifest.picture(one) for one in manifest.pictures],
        )


main()
