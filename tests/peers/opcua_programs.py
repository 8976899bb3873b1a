"""Runs an asyncua server as a machine that knows Programs of OPC 10000-10 and not the space, and
prints the calls.

Its object `machine` has
- Stamp, a Program with a parameter and a result whose run takes `--seconds`, and fails if Force is
  above 90;
- Blink, a Program without parameters whose run ends before its Start returns;
- Grasp, of the type of an earlier system (https://fortiss.org/UA/Device/ GraspGripperSkillType),
  whose state has no Id;
- a second Program with the name Stamp, with parameters of structures: a frame, ranges, and a
  structure without numbers; at its end it returns the frame as a vector;
- Odd, a Program that does not show its state.

With --deaf the Start of the first Stamp never returns, and nobody sees whether it runs.

The Start of all of them is accepted in any state, like in an earlier system: the caller has to
check the state.
"""

import argparse
import asyncio

from asyncua import Server, ua

import lifetime

URI = "urn:ua-bridge:system-tests:machine"
EARLIER = "https://fortiss.org/UA/Device/"
STATES = {"Halted": (2406, 11), "Ready": (2400, 12), "Running": (2402, 13), "Suspended": (2404, 14)}
PROGRAM = ua.NodeId(ua.ObjectIds.ProgramStateMachineType)


def core(name):
    return ua.QualifiedName(name, 0)


async def bare(parent, node, name, of_type):
    """Adds an object of a type without the children of the type."""
    item = ua.AddNodesItem()
    item.RequestedNewNodeId, item.BrowseName, item.ParentNodeId = node, name, parent.nodeid
    item.ReferenceTypeId = ua.NodeId(ua.ObjectIds.HasComponent)
    item.NodeClass = ua.NodeClass.Object
    item.TypeDefinition = of_type
    item.NodeAttributes = ua.ObjectAttributes(DisplayName=ua.LocalizedText(name.Name))
    added = (await parent.session.add_nodes([item]))[0]
    added.StatusCode.check()
    return parent.__class__(parent.session, added.AddedNodeId)


class Program:
    def __init__(self, space, first, name, seconds, deaf=False):
        self.space, self.first, self.name, self.seconds = space, first, name, seconds
        self.deaf = deaf
        self.state, self.run = "Halted", None

    def id(self, offset):
        return ua.NodeId(self.first + offset, self.space)

    async def build(self, parent, of_type=PROGRAM, with_id=True, with_state=True, structured=False, parts=True):
        own = lambda name: ua.QualifiedName(name, self.space)
        self.node = await bare(parent, self.id(0), own(self.name), of_type)
        shown = ua.LocalizedText("Halted") if with_state else ua.LocalizedText("?")
        self.current = await self.node.add_variable(self.id(1), core("CurrentState"), shown)
        self.state_id = None
        if with_id:
            state_id = ua.Variant(ua.NodeId(2406), ua.VariantType.NodeId)
            self.state_id = await self.current.add_property(self.id(2), core("Id"), state_id)
        for at, name in enumerate(["Start", "Halt", "Suspend", "Resume", "Reset"]):
            await self.node.add_method(self.id(10 + at), core(name), self.called(name), [], [])
        self.force = self.parts = self.target = self.bounds = self.reached = None
        if not parts:
            return
        group = await self.node.add_object(self.id(20), own("ParameterSet"))
        force = ua.Variant(20.0, ua.VariantType.Double)
        self.force = await group.add_variable(self.id(21), own("Force"), force)
        await self.force.set_writable()
        if structured:
            of = lambda name: ua.NodeId(getattr(ua.ObjectIds, name))
            await group.add_variable(self.id(22), own("Where"), ua.Variant(None), datatype=of("EUInformation"))
            frame = ua.Variant(ua.ThreeDFrame(), ua.VariantType.ExtensionObject)
            self.target = await group.add_variable(self.id(23), own("Target"), frame, datatype=of("ThreeDFrame"))
            ranges = ua.Variant([ua.Range(-1.0, 1.0)], ua.VariantType.ExtensionObject)
            self.bounds = await group.add_variable(self.id(24), own("Bounds"), ranges, datatype=of("Range"))
            await self.target.set_writable()
            await self.bounds.set_writable()
        results = await self.node.add_object(self.id(30), core("FinalResultData"))
        self.parts = await results.add_variable(self.id(31), own("Parts"), ua.Variant(0, ua.VariantType.Int32))
        if structured:
            vector = ua.Variant(ua.ThreeDVector(), ua.VariantType.ExtensionObject)
            self.reached = await results.add_variable(self.id(32), own("Reached"), vector, datatype=of("ThreeDVector"))

    def called(self, name):
        async def call(_parent):
            return await getattr(self, name.lower())()

        return call

    async def go(self, state):
        self.state = state
        node, _ = STATES[state]
        if self.state_id:
            await self.state_id.write_value(ua.Variant(ua.NodeId(node), ua.VariantType.NodeId))
        await self.current.write_value(ua.LocalizedText(state))

    async def start(self):
        force = await self.force.read_value() if self.force else None
        more = {}
        if self.target:
            frame = await self.target.read_value()
            at, turned = frame.CartesianCoordinates, frame.Orientation
            more["target"] = [at.X, at.Y, at.Z, turned.A, turned.B, turned.C]
            more["bounds"] = [[one.Low, one.High] for one in await self.bounds.read_value()]
            reached = ua.ThreeDVector(at.X, at.Y, at.Z)
            await self.reached.write_value(ua.Variant(reached, ua.VariantType.ExtensionObject))
        lifetime.say(started=self.name, first=self.first, state=self.state, force=force, **more)
        if self.deaf:
            await asyncio.Event().wait()
        await self.go("Running")
        if self.seconds:
            self.run = asyncio.create_task(self.work(force))
        else:
            await self.go("Ready")
        return []

    async def work(self, force):
        await asyncio.sleep(self.seconds)
        if force and force > 90:
            await self.go("Halted")
            return
        if self.parts:
            done = await self.parts.read_value()
            await self.parts.write_value(ua.Variant(done + 1, ua.VariantType.Int32))
        await self.go("Ready")

    async def halt(self):
        lifetime.say(halted=self.name, state=self.state)
        if self.run:
            self.run.cancel()
        await self.go("Halted")
        return []

    async def reset(self):
        await self.go("Ready")
        return []

    async def suspend(self):
        return ua.StatusCode(ua.StatusCodes.BadNotSupported)

    async def resume(self):
        return ua.StatusCode(ua.StatusCodes.BadNotSupported)


async def run(args):
    server = Server()
    await server.init()
    await server.set_application_uri(args.uri)
    server.name = "machine"
    server.set_endpoint(args.endpoint)
    server.set_security_policy([ua.SecurityPolicyType.NoSecurity])
    earlier = await server.register_namespace(EARLIER)
    space = await server.register_namespace(URI)
    of_all = await server.get_node(PROGRAM).add_object_type(ua.NodeId(1, earlier), ua.QualifiedName("SkillType", earlier))
    name = ua.QualifiedName("GraspGripperSkillType", earlier)
    grasp_type = await of_all.add_object_type(ua.NodeId(2, earlier), name)
    machine = await server.nodes.objects.add_object(ua.NodeId(1, space), ua.QualifiedName("machine", space))
    await Program(space, 1000, "Stamp", args.seconds, args.deaf).build(machine)
    await Program(space, 2000, "Blink", 0).build(machine, parts=False)
    await Program(space, 3000, "Grasp", 0.2).build(machine, of_type=grasp_type.nodeid, with_id=False)
    await Program(space, 4000, "Stamp", 0.2).build(machine, structured=True)
    await Program(space, 5000, "Odd", 0.2).build(machine, with_id=False, with_state=False)
    async with server:
        lifetime.say(ready=args.endpoint)
        await asyncio.Event().wait()


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("endpoint")
    parser.add_argument("--seconds", type=float, default=2.5)
    parser.add_argument("--uri", default=URI, help="its ApplicationUri")
    parser.add_argument("--deaf", action="store_true", help="the Start of the first Stamp never returns")
    parser.add_argument("--limit", type=float, default=120.0)
    args = parser.parse_args()
    lifetime.bound(args.limit)
    asyncio.run(run(args))


main()
