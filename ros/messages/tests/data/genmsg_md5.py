"""Prints name and MD5 of each .srv and of the seven messages of each .action below a folder, as
genmsg computes them.

    python3 genmsg_md5.py <folder>

It needs Debian's python3-genmsg and the message packages that the folder uses. A line
`? name: why` is a type that cannot be resolved here.
"""
import importlib
import os
import sys

import genmsg
from genmsg import gentools, msg_loader

context = genmsg.msg_loader.MsgContext.create_default()
texts = {}  # of messages
services = {}


def below(folder):
    for path, folders, files in os.walk(folder):
        folders.sort()
        for file in sorted(files):
            stem, kind = os.path.splitext(file)
            if kind in (".msg", ".srv", ".action") and os.path.basename(path) == kind[1:]:
                name = os.path.basename(os.path.dirname(path)) + "/" + stem
                with open(os.path.join(path, file), encoding="utf-8") as text:
                    yield kind, name, text.read()


def action(name, text):
    """Adds the messages of an action (http://wiki.ros.org/actionlib/DetailedDescription) and yields
    their names."""
    pieces = [[]]
    for line in text.split("\n"):
        if line.startswith("---"):
            pieces.append([])
        else:
            pieces[-1].append(line)
    goal, result, feedback = ("\n".join(piece) for piece in pieces)
    short = name.split("/")[1]
    head = "Header header\nactionlib_msgs/Goal"
    made = {
        "Goal": goal, "Result": result, "Feedback": feedback,
        "ActionGoal": f"{head}ID goal_id\n{short}Goal goal\n",
        "ActionResult": f"{head}Status status\n{short}Result result\n",
        "ActionFeedback": f"{head}Status status\n{short}Feedback feedback\n",
        "Action": "".join(f"{short}Action{part} action_{part.lower()}\n" for part in ("Goal", "Result", "Feedback")),
    }  # fmt: skip
    for suffix, part in made.items():
        texts[name + suffix] = part
        yield name + suffix


def text_of(name):
    if name in texts:
        return texts[name]
    package, short = name.split("/")
    return getattr(importlib.import_module(package + ".msg"), short)._full_text.split("\n====")[0]


def register(spec):
    for kind in spec.types:
        bare = genmsg.msgs.bare_msg_type(kind)
        if not genmsg.msgs.is_builtin(bare) and not context.is_registered(bare):
            register(msg_loader.load_msg_from_string(context, text_of(bare), bare))


names = []
for kind, name, text in below(sys.argv[1]):
    if kind == ".msg":
        texts[name] = text
    elif kind == ".srv":
        services[name] = text
    else:
        names += action(name, text)
for name in sorted(services) + names:
    try:
        if name in services:
            spec = msg_loader.load_srv_from_string(context, services[name], name)
            register(spec.request)
            register(spec.response)
        else:
            spec = msg_loader.load_msg_from_string(context, text_of(name), name)
            register(spec)
        print(name, gentools.compute_md5(context, spec))
    except Exception as error:
        print(f"? {name}: {error}")
