"""Makes ROS 1 message, service and action classes of definition files at run time, by genmsg and
genpy.

A folder is searched for `<package>/msg/<Name>.msg`, `srv/<Name>.srv` and `action/<Name>.action`;
definitions that are not in the folder are taken from the installed Python packages.
"""

import os

import genmsg
import genmsg.gentools
import genmsg.msg_loader
import genmsg.msgs
import genpy.dynamic
import roslib.message

RULE = "=" * 80


class Definitions:
    def __init__(self, folder):
        self.context = genmsg.MsgContext.create_default()
        self.texts = {}
        self.classes = {}
        for place, _, files in os.walk(folder):
            kind = os.path.basename(place)
            package = os.path.basename(os.path.dirname(place))
            for file in files:
                name, extension = os.path.splitext(file)
                if extension == "." + kind:
                    with open(os.path.join(place, file), encoding="utf-8") as text:
                        self.texts[f"{package}/{name}", kind] = text.read()

    def message(self, name):
        """Returns the class of a message, such as `niryo_robot_msgs/RobotState`."""
        if (name, "msg") not in self.texts:
            installed = roslib.message.get_message_class(name)
            if installed is not None:
                return installed
        return self._class(name, self._load(name))

    def service(self, name):
        """Returns the class of a service, for rospy.Service and rospy.ServiceProxy."""
        spec = genmsg.msg_loader.load_srv_from_string(self.context, self.texts[name, "srv"], name)
        self._load_parts(spec.request)
        self._load_parts(spec.response)
        parts = {
            "_type": name,
            "_md5sum": genmsg.gentools.compute_md5(self.context, spec),
            "_request_class": self._class(name + "Request", spec.request),
            "_response_class": self._class(name + "Response", spec.response),
        }
        return type(name.rpartition("/")[2], (), parts)

    def action(self, name):
        """Returns the class of an action, for actionlib.SimpleActionServer."""
        goal, result, feedback = self.texts[name, "action"].split("---")
        header = "Header header\n"
        status = "actionlib_msgs/GoalStatus status\n"
        made = {
            "Goal": goal,
            "Result": result,
            "Feedback": feedback,
            "ActionGoal": f"{header}actionlib_msgs/GoalID goal_id\n{name}Goal goal\n",
            "ActionResult": f"{header}{status}{name}Result result\n",
            "ActionFeedback": f"{header}{status}{name}Feedback feedback\n",
            "Action": (
                f"{name}ActionGoal action_goal\n{name}ActionResult action_result\n"
                f"{name}ActionFeedback action_feedback\n"
            ),
        }
        for part, text in made.items():
            self.texts[name + part, "msg"] = text
        return self.message(name + "Action")

    def _class(self, name, spec):
        if name not in self.classes:
            text = genmsg.gentools.compute_full_text(self.context, spec)
            self.classes[name] = genpy.dynamic.generate_dynamic(name, text)[name]
        return self.classes[name]

    def _load(self, name):
        if self.context.is_registered(name):
            return self.context.get_registered(name)
        text = self.texts.get((name, "msg"))
        if text is None:
            installed = roslib.message.get_message_class(name)
            if installed is None:
                raise SystemExit(f"no definition of {name}")
            text = installed._full_text.split(RULE)[0]
        spec = genmsg.msg_loader.load_msg_from_string(self.context, text, name)
        self._load_parts(spec)
        return spec

    def _load_parts(self, spec):
        parts = set()
        for part in spec.types:
            part = genmsg.msgs.bare_msg_type(part)
            if genmsg.msgs.is_builtin(part):
                continue
            part = "std_msgs/Header" if part == "Header" else part
            self._load(part)
            parts.add(part)
        inner = {dep for part in parts for dep in self.context.get_depends(part) or []}
        self.context.set_depends(spec.full_name, sorted(parts | inner))
