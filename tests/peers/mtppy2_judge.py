"""Judges our reader and our executor of MTP 2.0 by MTPPy2.0 (Python 3.13).

Reads a manifest with the reader of MTPPy2.0 and with `ua-space mtp`, and compares services, procedures,
parameters, outputs and nodes. Then MTPPy2.0 serves a module of the same package, and `ua-space mtp run`
runs its services.

    mtppy2_judge.py --binaries DIR --manifest FILE.aml

The name of the module and its services are those of tests/data/mtp/column.aml.
"""

import argparse
import contextlib
import io
import json
import pathlib
import subprocess
import sys
import tempfile
import time
import zipfile
from xml.etree import ElementTree

LOGIC = '''
from mtppy.pea.application_logic.application_logic_registry import register


@register("Heating.Ramp.idle.entry", "Heating.Ramp.starting.entry")
def admit(service):
    # Parameters are applied while ApplyEn is true.
    for name in ["Setpoint", "Steps", "Gentle", "Comment"]:
        service.get_base_interface(name).ApplyEn = True
    return True


@register("Heating.Ramp.execute.do")
def heat(service):
    service.get_base_interface("Energy").V = 12.5
    # Ramp completes by itself.
    service.state_machine.complete()
    return True
'''

CAEX = "http://www.dke.de/CAEX"
SERVICE = "MTPServiceSUCLib/Service"
PROCEDURE = "MTPServiceSUCLib/Service/Procedure"
PARAMETERS = "MTPServiceSUCLib/ServiceParameter/"
OUTPUTS = ("ReportValue", "ProcessValueOut", "ProcessValueIn")


def members(of):
    """Returns the elements within an element, with their names and types."""
    return {name: one["RefBaseSystemUnitPath"] for name, one in of.items()
            if isinstance(one, dict) and "RefBaseSystemUnitPath" in one}


def theirs(package):
    """Returns the procedures with their parameters and outputs, and the nodes, as MTPPy2.0 reads them."""
    from mtppy.utils.mtp_file_handling.mtp_reader.mtp_reader import MtpReader
    reader = MtpReader(package)
    procedures = {}
    for service_name, service in reader.services.items():
        if service.get("RefBaseSystemUnitPath") != SERVICE:
            continue
        own = members(service)
        for name, kind in own.items():
            if kind != PROCEDURE:
                continue
            procedure = service[name]
            inside = members(procedure)
            all_of = {**inside, **own}
            procedures[f"{service_name}/{name}"] = {
                "number": int(procedure["ProcedureID"]["value"]),
                "parameters": sorted(one for one, of in all_of.items() if of.startswith(PARAMETERS)),
                "outputs": sorted(one for one, of in all_of.items() if of.rsplit("/", 1)[-1] in OUTPUTS),
            }
    # As ns=<URI>;s=<identifier>, also of numbers.
    nodes = sorted(one.replace("ns=", "nsu=", 1) for one in reader.node_ids.values())
    return {"procedures": procedures, "nodes": nodes}


def ours(space, manifest):
    """Returns the same as `ua-space mtp` reads it."""
    run = lambda *words: subprocess.run([*space, "mtp", *words], check=True, capture_output=True, text=True).stdout
    procedures = {}
    for row in json.loads(run("skills", manifest, "--json")):
        procedures[row["skill"]] = {
            "number": row["number"],
            "parameters": sorted(one["name"] for one in row["parameters"]),
            "outputs": sorted(one["name"] for one in row["outputs"]),
        }
    statements = json.loads(run("rdf", manifest, "--json"))
    nodes = {one["object"]["value"] for one in statements if one["predicate"] == "urn:ua-bridge:plant#nodeId"}
    return {"procedures": procedures, "nodes": sorted(one.replace(";i=", ";s=") for one in nodes)}


def package(manifest, path):
    """Writes a package, and returns its path."""
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("manifest.aml", manifest)
    return path


def servable(manifest):
    """Returns a manifest that MTPPy2.0 can serve: each data assembly has a TagName, each parameter has
    Sync as a node, report values are of its library, and elements of services that it does not know are
    left out."""
    ElementTree.register_namespace("", CAEX)
    root = ElementTree.fromstring(manifest)
    of = lambda name: f"{{{CAEX}}}{name}"
    nodes = {one: parent for parent in root.iter() for one in parent.findall(of("ExternalInterface"))
             if one.get("Name").endswith(".ApplyExt")}
    for apply, parent in nodes.items():
        text = ElementTree.tostring(apply, "unicode").replace(".ApplyExt", ".Sync")
        parent.append(ElementTree.fromstring(text))
    for hierarchy in root.findall(of("InstanceHierarchy")):
        if hierarchy.get("Name") == "DataAssemblies":
            for assembly in hierarchy.findall(of("InternalElement")):
                tag = ElementTree.SubElement(assembly, of("Attribute"), {"Name": "TagName"})
                ElementTree.SubElement(tag, of("Value")).text = assembly.get("Name")
                # The values of its variables are the defaults of the file.
                for attribute in assembly.findall(of("Attribute")):
                    if (attribute.get("RefAttributeType") or "").endswith("/StaticValueAttributeType"):
                        default = ElementTree.Element(of("DefaultValue"))
                        default.text = attribute.findtext(of("Value"))
                        attribute.insert(0, default)
                link = next((one for one in assembly.findall(of("Attribute")) if one.get("Name") == "ApplyExt"), None)
                if link is not None:
                    for sync in [one for one in assembly.findall(of("Attribute")) if one.get("Name") == "Sync"]:
                        assembly.remove(sync)
                    text = ElementTree.tostring(link, "unicode").replace("ApplyExt", "Sync")
                    assembly.append(ElementTree.fromstring(text))
                kind = assembly.get("RefBaseSystemUnitPath")
                if kind.endswith("/PeaInformationLabel"):
                    assembly.set("RefBaseSystemUnitPath", "MTPDataAssemblySUCLib/DataAssembly/PeaElement/PeaInformationLabel")
        if hierarchy.get("Name") == "Services":
            for parent in list(hierarchy.iter(of("InternalElement"))):
                for child in list(parent.findall(of("InternalElement"))):
                    path = child.get("RefBaseSystemUnitPath")
                    child.set("RefBaseSystemUnitPath", path.replace("MTPSUCLib/LinkedObject/", "MTPServiceSUCLib/"))
                    if path.rsplit("/", 1)[-1] in ("ConfigurationParameter", "ProcessValueIn", "ProcessValueOut", "RequiredEquipment"):
                        parent.remove(child)
    return ElementTree.tostring(root, "unicode")


def serve(package, folder, endpoint):
    """Starts a module of MTPPy2.0 in another process, and waits until its nodes are there."""
    (folder / "column_logic.py").write_text(LOGIC)
    command = [sys.executable, "-m", "mtppy.pea.rmtp_pea", "--rmtp", package.with_suffix(""), "--user-logic", "column_logic",
               "--cycle-time", "0.1", "--endpoint", endpoint, "--daemon"]
    log = (folder / "module.log").open("w")
    # Its reader unpacks the package beside the folder in which it runs.
    inside = folder / "run"
    inside.mkdir()
    environment = {"PYTHONPATH": str(folder), "PATH": "/usr/bin:/bin"}
    module = subprocess.Popen(command, cwd=inside, env=environment, stdout=log, stderr=subprocess.STDOUT)
    until = time.monotonic() + 60
    while time.monotonic() < until and module.poll() is None:
        # Its port is open before.
        if "PEA OPC UA server started" in (folder / "module.log").read_text():
            return module
        time.sleep(0.2)
    module.kill()
    raise SystemExit(f"the module of MTPPy2.0 does not answer:\n{(folder / 'module.log').read_text()[-4000:]}")


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--binaries", type=pathlib.Path, required=True)
    parser.add_argument("--manifest", type=pathlib.Path, required=True)
    arguments = parser.parse_args()
    space = [arguments.binaries / "ua-space"]
    faults = []
    with tempfile.TemporaryDirectory() as name:
        folder = pathlib.Path(name)
        manifest = arguments.manifest.read_text()
        whole = package(manifest, folder / "whole.mtp")
        small = package(servable(manifest), folder / "column.mtp")
        # Its reader prints.
        inside = folder / "read"
        inside.mkdir()
        with contextlib.redirect_stdout(io.StringIO()), contextlib.chdir(inside):
            their = theirs(whole)
        our = ours(space, whole)
        if their["procedures"] != our["procedures"]:
            faults.append({"procedures": {"MTPPy2.0": their["procedures"], "ours": our["procedures"]}})
        if their["nodes"] != our["nodes"]:
            differ = set(their["nodes"]) ^ set(our["nodes"])
            faults.append({"nodes": {"MTPPy2.0": len(their["nodes"]), "ours": len(our["nodes"]), "differ": sorted(differ)[:20]}})
        endpoint = "opc.tcp://127.0.0.1:48455"
        module = serve(small, folder, endpoint)
        try:
            run = [*space, "mtp", "run", small, "--endpoint", endpoint, "--json"]
            for words, wanted in [
                (["Heating", "--procedure", "Ramp", "Setpoint=60", "Steps=2", "Gentle=true", "Comment=warm"], "Energy"),
                # It has to be reset.
                (["Heating", "--procedure", "Ramp", "Setpoint=70", "Steps=3", "Gentle=false", "Comment=warmer"], "Energy"),
                (["Heating", "--procedure", "Keep", "RunTime=0.5"], "Completed"),
            ]:
                ended = subprocess.run([*run[:4], *words, *run[4:]], capture_output=True, text=True, timeout=120)
                if ended.returncode or wanted not in ended.stdout:
                    faults.append({"run": words, "code": ended.returncode, "out": ended.stdout[-2000:], "error": ended.stderr[-2000:]})
            if faults:
                faults.append({"module": (folder / "module.log").read_text()[-3000:]})
        finally:
            module.terminate()
            module.wait(20)
    print(json.dumps({"procedures": len(our["procedures"]), "nodes": len(our["nodes"]), "faults": faults}, indent=2))
    sys.exit(bool(faults))


if __name__ == "__main__":
    main()
