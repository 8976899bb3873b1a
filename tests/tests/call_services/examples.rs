//! Runs the examples of `docs/calls.md` as they are printed there.

use std::time::Duration;

use system_tests::{Cell, Child, Distribution, Peer, StartedChild, eventually, program};

/// The time that rospy and rclpy need to start on a busy machine.
const SOON: Duration = Duration::from_secs(60);
const SECTION: &str = "### Three examples to paste\n";

/// An example of the page.
#[derive(Default)]
struct Example {
    /// The files: name and text.
    files: Vec<(String, String)>,
    commands: Vec<Command>,
    /// The expected output of the last command.
    prints: String,
}

struct Command {
    words: Vec<String>,
    /// The setup that the command needs, from the comment behind it.
    place: String,
}

impl Command {
    fn of(line: &str) -> Self {
        let (command, place) = line.split_once('#').unwrap_or((line, ""));
        Self {
            words: command.split_whitespace().map(str::to_owned).collect(),
            place: place.trim().to_owned(),
        }
    }

    /// Returns the program in its environment and in the folder with the files.
    fn started(&self, cell: &Cell) -> StartedChild {
        let (name, args) = self.words.split_first().unwrap();
        let ros1 = self.place.starts_with("ROS 1");
        let python = match &self.place[..] {
            place if place.starts_with("ROS 2") => Distribution::Jazzy.python(),
            "asyncua" => cell.asyncua_python().to_owned(),
            _ => "/usr/bin/python3".into(),
        };
        let program = match &name[..] {
            "python3" => python,
            name => program(name),
        };
        let started = StartedChild::new(&self.words.join(" "), &program)
            .args(args)
            .in_folder(cell.folder())
            .env("HOME", cell.folder())
            .env("ROS_DOMAIN_ID", "2");
        let started = match ros1 {
            true => cell.with_ros1(started),
            false => started.env("ROS_LOG_DIR", cell.folder().join("log")),
        };
        match self.place.ends_with("nav2_msgs") {
            true => started.env("AMENT_PREFIX_PATH", cell.nav2_prefix()),
            false => started,
        }
    }
}

/// Returns the example with this mapping.
fn example(mapping: &str) -> Example {
    let page = concat!(env!("CARGO_MANIFEST_DIR"), "/../docs/calls.md");
    let page = std::fs::read_to_string(page).unwrap();
    let (_, section) = page.split_once(SECTION).expect("the page has the section");
    let (section, _) = section.split_once("\n## ").unwrap_or((section, ""));
    let mut example = Example::default();
    // Of the texts between fences, every second text is a block.
    for block in section.split("```").skip(1).step_by(2) {
        let (language, text) = block.split_once('\n').unwrap();
        match language {
            "sh" => example.commands = text.lines().map(Command::of).collect(),
            "text" => {
                text.clone_into(&mut example.prints);
                if example.files.iter().any(|(name, _)| name == mapping) {
                    return example;
                }
                example = Example::default();
            }
            _ => {
                let (head, _) = text.split_once('\n').unwrap();
                let name = head.trim_start_matches("# ").to_owned();
                example.files.push((name, text.to_owned()));
            }
        }
    }
    panic!("docs/calls.md has no example with {mapping}");
}

/// Runs an example. `others` replaces the programs of the reader; a roscore is started where the
/// example says so.
fn runs(example: &Example, others: impl FnOnce(&Cell) -> Option<Child>) {
    let Some(cell) = Cell::with(&[Peer::Ros1, Peer::Ros2, Peer::Python]) else {
        return;
    };
    for (name, text) in &example.files {
        let _ = cell.file(name, text);
    }
    let mut running = Vec::new();
    running.extend(others(&cell));
    let (last, before) = example.commands.split_last().unwrap();
    for command in before {
        running.push(match command.words[0] == "roscore" {
            true => cell.roscore(),
            false => command.started(&cell).start(),
        });
    }
    // The called service may not be available at once.
    eventually("the last one ends well", SOON, || {
        let mut asker = last.started(&cell).start();
        asker.wait_for_end(SOON).success().then(|| {
            // The output may be read after the end of the process, and libraries print lines of
            // their own.
            let wanted = example.prints.trim_end();
            eventually(wanted, SOON, || {
                asker
                    .lines()
                    .iter()
                    .any(|line| line == wanted)
                    .then_some(())
            });
        })
    });
}

#[test]
fn a_client_of_ros_2_calls_a_service_of_ros_1_as_the_page_prints_it() {
    runs(&example("belt.yaml"), |_| None);
}

#[test]
fn an_opc_ua_client_calls_a_service_of_ros_2_as_the_page_prints_it() {
    runs(&example("lamp.yaml"), |_| None);
}

#[test]
fn a_client_of_ros_1_drives_a_base_of_ros_2_as_the_page_prints_it() {
    runs(&example("base.yaml"), |cell| {
        Some(cell.cyclone("calls/ros2_navigate.py", &["/navigate_to_pose"]))
    });
}
