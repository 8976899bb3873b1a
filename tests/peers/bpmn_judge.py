"""Runs a BPMN file with SpiffWorkflow, and the plan of ua-mes for it by the same decisions.

    bpmn_judge.py FILE.bpmn URL PROCESS CASES.json

CASES is a list of decisions: {"failed": [TASK..], "timed out": [TASK..], "values": {ID: {RESULT: V}}}
with the names of service tasks, and their IDs for results. The plan is the steps and conditions of
the process in the graph at URL. Each case gets a JSON line: for both the tasks that run, as rounds of
tasks that may run at a time.
"""

import copy
import json
import re
import sys
import tempfile
import types
import urllib.parse
import urllib.request

from SpiffWorkflow.bpmn import BpmnEvent
from SpiffWorkflow.bpmn.parser.BpmnParser import BpmnParser
from SpiffWorkflow.bpmn.specs.event_definitions.timer import TimerEventDefinition
from SpiffWorkflow.bpmn.specs.mixins.service_task import ServiceTask
from SpiffWorkflow.bpmn.workflow import BpmnWorkflow
from SpiffWorkflow.util.task import TaskState

import lifetime

ROUNDS = 20


def specification(file):
    """Parses the file. SpiffWorkflow reads timers and conditions as Python: the text PT20S needs
    quotes there, and ${a.B} is a.B."""
    with open(file, encoding="utf-8") as opened:
        text = opened.read()
    text = re.sub(r">\s*(P[0-9T][0-9A-Z.]*)\s*</", r'>"\1"</', text)
    text = re.sub(r">\s*\$\{([^}]*)\}\s*</", r">\1</", text)
    with tempfile.NamedTemporaryFile("w", suffix=".bpmn", encoding="utf-8") as copied:
        copied.write(text)
        copied.flush()
        parser = BpmnParser()
        parser.add_bpmn_file(copied.name)
    return parser.get_spec(parser.get_process_ids()[0])


def is_service(task):
    return isinstance(task.task_spec, ServiceTask)


def name_of(task):
    return task.task_spec.bpmn_name or task.task_spec.bpmn_id


def end(workflow, task, case):
    """Ends a task: by its boundary event, or well."""
    name = name_of(task)
    bad = "failed" if name in case.get("failed", []) else None
    bad = "timed out" if name in case.get("timed out", []) else bad
    if bad is None:
        values = case.get("values", {}).get(task.task_spec.bpmn_id, {})
        task.data[task.task_spec.bpmn_id] = types.SimpleNamespace(**values)
        if task.state == TaskState.READY:
            task.run()
        if task.state == TaskState.STARTED:
            task.complete()
        return
    for event in task.parent.children:
        definition = getattr(event.task_spec, "event_definition", None)
        is_timer = isinstance(definition, TimerEventDefinition)
        if definition is not None and is_timer == (bad == "timed out"):
            if is_timer:
                # The time of the timer is over.
                event.set_ready() if hasattr(event, "set_ready") else event._ready()
            else:
                workflow.catch(BpmnEvent(definition))
                workflow.refresh_waiting_tasks()
            workflow.do_engine_steps()
            return
    raise RuntimeError(f"the task {name} has no boundary event for its bad end: {bad}")


def by_spiff(spec, case):
    workflow = BpmnWorkflow(spec)
    rounds = []
    for _ in range(ROUNDS):
        # A ready service task waits for this judge; all other elements run by themselves.
        workflow.do_engine_steps(will_complete_task=None)
        open_tasks = [
            task
            for task in workflow.get_tasks(state=TaskState.READY | TaskState.STARTED)
            if is_service(task)
        ]
        if not open_tasks:
            return rounds if workflow.is_completed() else rounds + [["stuck"]]
        rounds.append(sorted(name_of(task) for task in open_tasks))
        for task in open_tasks:
            end(workflow, task, case)
    return rounds + [["no end"]]


def ask(url, question, process):
    narrowed = urllib.parse.urlencode({"process": process})
    with urllib.request.urlopen(f"{url}/ask/{question}?{narrowed}", timeout=20) as answer:
        return json.load(answer)["rows"]


class Plan:
    """The steps of a process in the graph, with their order and conditions."""

    def __init__(self, url, process):
        self.names, places, self.after, self.when = {}, {}, {}, {}
        for row in ask(url, "process-steps", process):
            part = row["part"]
            self.names[part] = row["step"]
            places[part] = row["position"]
            if row["after"] is not None:
                self.after.setdefault(part, set()).add(row["after"])
        order = sorted(places, key=places.get)
        for before, part in zip([None, *order], order):
            # Without a statement a step comes after the step before it; `after` the process itself
            # is after no step.
            usual = set() if before is None else {before}
            self.after[part] = self.after.get(part, usual) - {process}
        for row in ask(url, "process-conditions", process):
            alternative = self.when.setdefault(row["part"], {})
            alternative.setdefault(row["alternative"], []).append(row)

    def holds(self, row, ends, case):
        of = row["of"]
        if row["ends_as"] is not None:
            holds = ends.get(of) == row["ends_as"]
        elif ends.get(of) != "well":
            return False
        else:
            values = case.get("values", {}).get(of.rsplit("/", 1)[-1], {})
            given, wanted = values.get(row["result"]), float(row["value"])
            holds = {
                "<": given < wanted,
                "<=": given <= wanted,
                ">": given > wanted,
                ">=": given >= wanted,
                "=": given == wanted,
                "==": given == wanted,
            }[row["compare"]]
        return holds != bool(row["negated"])

    def run(self, case):
        ends, rounds, waiting = {}, [], set(self.names)
        while waiting:
            ready = {
                part
                for part in waiting
                if not self.after[part] & waiting
                # A condition is decided when the step that it names is over.
                and not any(
                    row["of"] in waiting
                    for rows in self.when.get(part, {}).values()
                    for row in rows
                )
            }
            if not ready:
                return rounds + [["stuck"]]
            runs = []
            for part in sorted(ready):
                when = self.when.get(part, {}).values()
                if when and not any(
                    all(self.holds(row, ends, case) for row in rows) for rows in when
                ):
                    ends[part] = "left out"
                    continue
                name = self.names[part]
                runs.append(name)
                bad = [kind for kind in ("failed", "timed out") if name in case.get(kind, [])]
                ends[part] = bad[0] if bad else "well"
            waiting -= ready
            if runs:
                rounds.append(sorted(runs))
        return rounds


def main():
    lifetime.bound(60.0)
    file, url, process, cases = sys.argv[1:]
    spec = specification(file)
    plan = Plan(url, process)
    with open(cases, encoding="utf-8") as opened:
        for case in json.load(opened):
            lifetime.say(theirs=by_spiff(copy.deepcopy(spec), case), ours=plan.run(case))


main()
