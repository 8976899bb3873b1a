//! `ua-space completion`: completes words for shells, including the names received in the space.

use std::io::{self, Write as _};

use clap::{Arg, Command, CommandFactory as _, Parser};

use crate::arguments::{CompletionShell, GroupArguments, ToolArguments};
use crate::exit::CommandFailure;
use crate::live::{HeardNames, heard_names};

/// Runs `ua-space completion`.
pub(crate) fn script(shell: CompletionShell) -> Result<(), CommandFailure> {
    let text = match shell {
        CompletionShell::Bash => BASH,
        CompletionShell::Zsh => ZSH,
        CompletionShell::Fish => FISH,
    };
    io::stdout().lock().write_all(text.as_bytes())?;
    Ok(())
}

/// Runs `ua-space complete`: prints the candidates, a word per line. Failures give no candidates,
/// because a shell cannot use an error message.
pub(crate) fn complete(words: &[String]) -> Result<(), CommandFailure> {
    let (typed, before) = match words.split_last() {
        Some((typed, before)) => (typed.as_str(), before),
        None => ("", &[][..]),
    };
    let place = WordPosition::of(before);
    let mut found = place.words(typed);
    if let Some(kind) = place.names().filter(|_| !typed.starts_with('-')) {
        let heard = heard_names(&group(before)).unwrap_or_default();
        found.extend(kind.of(heard, typed));
    }
    found.retain(|word| word.starts_with(typed));
    found.sort();
    found.dedup();
    let mut out = io::stdout().lock();
    for word in found {
        writeln!(out, "{word}")?;
    }
    Ok(())
}

/// The position of the completed word in the command line.
struct WordPosition {
    command: Command,
    /// The option with the completed value.
    option: Option<Arg>,
    /// The number of positional words before the completed word.
    position: usize,
}

/// The kind of names that complete a word.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Names {
    Skills,
    /// Components and skills.
    Either,
    /// Skill types.
    Types,
    Calls,
    /// Values of the OPC UA side, which `write` writes.
    Written,
    /// Values, without calls.
    Values,
    /// Values and calls.
    Topics,
}

/// The verbs of values.
const VALUES: [&str; 5] = ["echo", "hz", "bw", "tap", "trace"];

impl WordPosition {
    fn of(before: &[String]) -> Self {
        let mut place = Self {
            command: ToolArguments::command(),
            option: None,
            position: 0,
        };
        // `build` adds the global arguments and the arguments that clap generates.
        place.command.build();
        for word in before {
            place.pass(word);
        }
        place
    }

    fn pass(&mut self, word: &str) {
        if self.option.take().is_some() {
            return;
        }
        if let Some(name) = word.strip_prefix("--") {
            let found = self
                .command
                .get_arguments()
                .find(|arg| arg.get_long() == Some(name) && arg.get_action().takes_values());
            self.option = found.cloned();
        } else if let Some(name) = word.strip_prefix('-') {
            let found = self.command.get_arguments().find(|arg| {
                let short = arg.get_short().map(String::from);
                short.as_deref() == Some(name) && arg.get_action().takes_values()
            });
            self.option = found.cloned();
        } else if let Some(below) = self.command.find_subcommand(word).cloned()
            && self.position == 0
        {
            self.command = below;
        } else {
            self.position += 1;
        }
    }

    /// Returns the candidates that do not depend on the space.
    fn words(&self, typed: &str) -> Vec<String> {
        let values = |arg: &Arg| -> Vec<String> {
            let values = arg.get_possible_values();
            values
                .iter()
                .map(|value| value.get_name().to_owned())
                .collect()
        };
        if let Some(option) = &self.option {
            return values(option);
        }
        if typed.starts_with('-') {
            let shown = self
                .command
                .get_arguments()
                .filter(|arg| !arg.is_hide_set());
            return shown
                .filter_map(|arg| Some(format!("--{}", arg.get_long()?)))
                .collect();
        }
        let mut words: Vec<String> = self.positional().map(values).unwrap_or_default();
        if self.position == 0 {
            let below = self.command.get_subcommands();
            let below = below.filter(|below| !below.is_hide_set() && below.get_name() != "help");
            words.extend(below.map(|below| below.get_name().to_owned()));
        }
        words
    }

    fn names(&self) -> Option<Names> {
        let completed = self.option.as_ref().or_else(|| self.positional())?;
        match completed.get_value_names()?.first()?.as_str() {
            "SKILL" => Some(Names::Skills),
            "COMPONENT|SKILL" => Some(Names::Either),
            "TYPE" => Some(Names::Types),
            "TOPIC|NAME" if self.command.get_name() == "start" => Some(Names::Skills),
            "TOPIC|NAME" if self.command.get_name() == "call" => Some(Names::Calls),
            "TOPIC|NAME" if self.command.get_name() == "write" => Some(Names::Written),
            "TOPIC|NAME" if VALUES.contains(&self.command.get_name()) => Some(Names::Values),
            "TOPIC|NAME" => Some(Names::Topics),
            _ => None,
        }
    }

    fn positional(&self) -> Option<&Arg> {
        self.command.get_positionals().nth(self.position)
    }
}

impl Names {
    fn of(self, heard: HeardNames, typed: &str) -> Vec<String> {
        let HeardNames {
            components,
            mut skills,
            types,
            calls,
            mut topics,
            names,
            values,
            written,
        } = heard;
        match self {
            Self::Skills => skills,
            Self::Either => {
                skills.extend(components);
                skills
            }
            Self::Types => types,
            Self::Calls if typed.starts_with("ua_") => topics,
            Self::Calls => {
                // The Start call of a skill is completed by the name of the skill alone.
                skills.extend(calls.into_iter().filter(|name| !name.ends_with(".Start")));
                skills
            }
            Self::Written => written,
            Self::Values => {
                topics.extend(values);
                topics
            }
            Self::Topics => {
                topics.extend(names);
                topics
            }
        }
    }
}

/// The options with a value that locate the space.
const GROUP_OPTIONS: [&str; 5] = ["--interface", "--address", "--broker", "--cell", "--keys"];

/// Returns the location of the space from the words typed so far and the environment.
fn group(before: &[String]) -> GroupArguments {
    let mut words = vec!["ua-space".to_owned()];
    let mut rest = before.iter();
    while let Some(word) = rest.next() {
        if GROUP_OPTIONS.contains(&word.as_str()) {
            words.push(word.clone());
            words.extend(rest.next().cloned());
        } else if word == "--sign" {
            words.push(word.clone());
        }
    }
    let read = OnlyGroup::try_parse_from(words);
    let or_usual = read.or_else(|_| OnlyGroup::try_parse_from(["ua-space"]));
    or_usual.map_or_else(|_| GroupArguments::default(), |only| only.group)
}

#[derive(Debug, Parser)]
struct OnlyGroup {
    #[command(flatten)]
    group: GroupArguments,
}

const BASH: &str = r#"_ua_space() {
  local line
  COMPREPLY=()
  while IFS= read -r line; do
    COMPREPLY+=("$line")
  done < <("${COMP_WORDS[0]}" complete -- "${COMP_WORDS[@]:1:COMP_CWORD}" 2>/dev/null)
}
complete -o default -F _ua_space ua-space
"#;

const ZSH: &str = r#"_ua_space() {
  local -a found
  found=("${(@f)$("${words[1]}" complete -- "${(@)words[2,CURRENT]}" 2>/dev/null)}")
  if [[ -n "${found[1]}" ]]; then
    compadd -- "${found[@]}"
  else
    _files
  fi
}
compdef _ua_space ua-space
"#;

const FISH: &str = r#"complete -c ua-space -a '(ua-space complete -- (commandline -opc)[2..] (commandline -ct) 2>/dev/null)'
"#;

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;

    fn place(line: &[&str]) -> WordPosition {
        let words: Vec<String> = line.iter().map(|word| (*word).to_owned()).collect();
        WordPosition::of(&words)
    }

    #[test]
    fn verbs_options_and_their_values_are_known_by_their_place() {
        let first = place(&[]).words("");
        assert!(first.contains(&"skills".to_owned()) && !first.contains(&"complete".to_owned()));
        let below = place(&["skills"]).words("");
        assert_eq!(below, ["list", "info", "start", "watch"]);
        let options = place(&["skills", "watch"]).words("--");
        assert!(
            options.contains(&"--seconds".to_owned())
                && options.contains(&"--interface".to_owned())
        );
        assert_eq!(place(&["keys", "--policy"]).words(""), ["aes128", "aes256"]);
        assert_eq!(place(&["completion"]).words(""), ["bash", "zsh", "fish"]);
    }

    #[test]
    fn names_are_of_what_the_word_is_to_be() {
        for (line, names) in [
            (&["skills"][..], Some(Names::Either)),
            (&["skills", "info"], Some(Names::Skills)),
            (
                &["skills", "--interface", "lo", "start"],
                Some(Names::Skills),
            ),
            (&["skills", "watch"], Some(Names::Either)),
            (&["call"], Some(Names::Calls)),
            (&["call", "gripper.Grasp"], None),
            (&["echo", "--seconds", "3"], Some(Names::Values)),
            (&["info"], Some(Names::Topics)),
            (&["write"], Some(Names::Written)),
            (&["trace", "--follow"], Some(Names::Values)),
            (&["types"], Some(Names::Types)),
            (&["echo", "--seconds"], None),
            (&["check"], None),
        ] {
            assert_eq!(place(line).names(), names, "{line:?}");
        }
        let heard = || HeardNames {
            components: vec!["gripper".to_owned()],
            skills: vec!["gripper.Grasp".to_owned()],
            types: vec!["GraspSkillType".to_owned()],
            calls: vec![
                "gripper.Grasp.Start".to_owned(),
                "gripper.Grasp.Halt".to_owned(),
            ],
            topics: vec!["ua_0_7_101".to_owned()],
            names: vec!["JointStates".to_owned(), "/joint_states".to_owned()],
            values: vec!["JointStates".to_owned()],
            written: vec!["Speed".to_owned()],
        };
        assert_eq!(Names::Written.of(heard(), "S"), ["Speed"]);
        assert_eq!(
            Names::Values.of(heard(), "J"),
            ["ua_0_7_101", "JointStates"]
        );
        assert_eq!(
            Names::Calls.of(heard(), "g"),
            ["gripper.Grasp", "gripper.Grasp.Halt"]
        );
        assert_eq!(Names::Types.of(heard(), "G"), ["GraspSkillType"]);
        let words = [
            "skills",
            "--interface",
            "lo",
            "--broker",
            "cell.yaml",
            "info",
        ];
        let located = group(&words.map(str::to_owned));
        assert_eq!(located.interface.as_deref(), Some("lo"));
        assert_eq!(located.broker.as_deref(), Some(Path::new("cell.yaml")));
    }
}
