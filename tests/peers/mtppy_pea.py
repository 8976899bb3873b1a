"""Serves a process module of MTPPy, whose code shares nothing with this project.

    mtppy_pea.py table             prints the state machine of MTPPy: commands in states
    mtppy_pea.py serve ENDPOINT    serves a module, and prints its manifest

The module has the service Stir: its procedure Slow (1) runs until Complete, Quick (2) completes by
itself after the parameter Time, in seconds, and reports the number of its turns.
"""

import sys
import time

import lifetime
from mtppy.command_codes import CommandCodes
from mtppy.indicator_elements import DIntView
from mtppy.opcua_server_pea import OPCUAServerPEA
from mtppy.operation_elements import AnaServParam
from mtppy.procedure import Procedure
from mtppy.service import Service
from mtppy.state_codes import StateCodes

ACTING = (
    "starting", "completing", "pausing", "resuming", "holding", "unholding", "stopping", "aborting",
    "resetting",
)
WAITING = ("idle", "completed", "paused", "held", "stopped", "aborted")


class Stir(Service):
    """A service whose acting states end at once."""

    def execute(self):
        number = self.procedure_control.get_procedure_cur()
        if number != 2:
            return
        procedure = self.procedures[2]
        end = time.monotonic() + procedure.procedure_parameters["Time"].get_v_out()
        while self.is_state("execute") and time.monotonic() < end:
            time.sleep(0.02)
        if self.is_state("execute"):
            procedure.report_values["Turns"].set_v(7)
            self.state_machine.complete()


def acts(self):
    time.sleep(0.02)
    self.state_change()


def waits(self):
    pass


for name in ACTING:
    setattr(Stir, name, acts)
for name in WAITING:
    setattr(Stir, name, waits)
Stir.__abstractmethods__ = frozenset()


def service():
    stir = Stir("Stir", "")
    slow = Procedure(1, "Slow", is_self_completing=False, is_default=True)
    quick = Procedure(2, "Quick", is_self_completing=True)
    quick.add_procedure_parameter(
        AnaServParam("Time", v_min=0, v_max=60, v_scl_min=0, v_scl_max=60, v_unit=1054)
    )
    quick.add_report_value(DIntView("Turns", v_scl_min=0, v_scl_max=100, v_unit=0))
    # MTPPy itself publishes CommandEn at changes of the state only, so it would stay 0 in Idle.
    machine = stir.state_machine
    stir.op_src_mode.add_exit_offline_callback(
        lambda: machine.attributes["CommandEn"].set_value(machine.command_en_ctrl.get_command_en())
    )
    stir.add_procedure(slow)
    stir.add_procedure(quick)
    return stir


def table():
    """Executes each command in each state. A state is followed by another one or stays."""
    states, commands = StateCodes(), CommandCodes()
    rows = []
    for word, state in states.int_code.items():
        for bit, command in commands.int_code.items():
            machine = service().state_machine
            machine.execution_routine = lambda: None
            machine.procedure_control.set_procedure_cur = lambda: None
            machine.procedure_control.apply_procedure_parameters = lambda: None
            machine._change_state_to(word)
            enabled = machine.attributes["CommandEn"].value
            machine.command_execution(bit)
            after = states.int_code[machine.act_state]
            rows.append([state, command, after, bool(enabled & bit)])
    lifetime.say(table=rows)


def manifest(endpoint):
    """Returns a manifest (MTP 1.x) with the nodes of the module. MTPPy needs a template to write one."""
    items, numbers = [], {}

    def attribute(name, value):
        return f'<Attribute Name="{name}"><Value>{value}</Value></Attribute>'

    def item(path):
        numbers[path] = f"n{len(numbers)}"
        items.append(
            f'<ExternalInterface Name="{path}" ID="{numbers[path]}" '
            'RefBaseClassPath="MTPCommunicationICLib/DataItem/OPCUAItem">'
            + attribute("Identifier", path) + attribute("Namespace", "3")
            + '<Attribute Name="Access" AttributeDataType="xs:unsignedByte"><Value>3</Value></Attribute>'
            + "</ExternalInterface>"
        )
        return numbers[path]

    def element(name, number, path, inner):
        return (
            f'<InternalElement Name="{name}" ID="{number}" RefBaseSystemUnitPath="{path}">'
            f"{inner}</InternalElement>"
        )

    stir = "services.Stir"
    links = attribute("RefID", "r-Stir")
    for folder, names in (
        ("state_machine", "CommandExt CommandEn StateCur"),
        ("procedure_control", "ProcedureExt ProcedureReq ProcedureCur"),
        (
            "op_src_mode",
            "StateAutAct StateAutOp StateOpAct StateOffAct SrcExtAct SrcExtOp SrcIntAct",
        ),
    ):
        for name in names.split():
            links += attribute(name, item(f"{stir}.{folder}.{name}"))
    data = "MTPDataObjectSUCLib/DataAssembly"
    control = element("Stir", "d-Stir", f"{data}/ServiceControl", links)
    quick = f"{stir}.procedures.Quick"
    links = attribute("RefID", "r-Time")
    for name in ("VExt", "VReq", "VOut", "VMin", "VMax"):
        links += attribute(name, item(f"{quick}.procedure_parameters.Time.{name}"))
    seconds = element("Time", "d-Time", f"{data}/AnaServParam", links)
    links = attribute("RefID", "r-Turns") + attribute("V", item(f"{quick}.report_values.Turns.V"))
    turns = element("Turns", "d-Turns", f"{data}/DIntView", links)
    service_library = "MTPServiceSUCLib"
    procedures = ""
    for number, name, completes, inner in (
        (1, "Slow", "false", ""),
        (
            2,
            "Quick",
            "true",
            element(
                "Time", "p-Time", f"{service_library}/ServiceParameter/ProcedureParameter",
                attribute("RefID", "r-Time"),
            )
            + element("Turns", "p-Turns", "MTPSUCLib/LinkedObject/ReportValue", attribute("RefID", "r-Turns")),
        ),
    ):
        inner = (
            attribute("ProcedureID", number) + attribute("IsDefault", str(number == 1).lower())
            + attribute("IsSelfCompleting", completes) + inner
        )
        procedures += element(name, f"p-{name}", f"{service_library}/ServiceProcedure", inner)
    server = element(
        "Server", "server", "MTPCommunicationSUCLib/ServerAssembly/OPCUAServer",
        attribute("Endpoint", endpoint) + "".join(items),
    )
    module = element(
        "Stirrer", "module", "MTPSUCLib/ModuleTypePackage",
        element(
            "Communication", "communication", "MTPSUCLib/CommunicationSet",
            element("Sources", "sources", "MTPSUCLib/CommunicationSet/SourceList", server)
            + element(
                "Instances", "instances", "MTPSUCLib/CommunicationSet/InstanceList",
                control + seconds + turns,
            ),
        ),
    )
    service_element = element(
        "Stir", "s-Stir", f"{service_library}/Service", attribute("RefID", "r-Stir") + procedures
    )
    return (
        '<CAEXFile FileName="Stirrer.aml" SchemaVersion="2.15">'
        f'<InstanceHierarchy Name="ModuleTypePackage" ID="h1">{module}</InstanceHierarchy>'
        f'<InstanceHierarchy Name="Services" ID="h2">{service_element}</InstanceHierarchy>'
        "</CAEXFile>\n"
    )


def serve(endpoint):
    module = OPCUAServerPEA(endpoint=endpoint)
    stir = service()
    module.add_service(stir)
    module.run_opcua_server()
    lifetime.say(manifest=manifest(endpoint))
    while True:
        time.sleep(0.05)


def main():
    lifetime.bound(180.0)
    if sys.argv[1:2] == ["table"]:
        table()
    else:
        serve(sys.argv[2])


main()
