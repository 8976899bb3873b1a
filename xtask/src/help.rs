//! The help texts of the programs, as `--help` prints them.

use std::{path::Path, process::Command};

use anyhow::{Context as _, ensure};

use crate::{links, shell::line};

/// Verbs that the help of their program lists outside of its commands.
const FURTHER: [&[&str]; 7] = [
    &["ua-component", "modules"],
    &["ua-component", "simulate"],
    &["ua-server", "certificates"],
    &["ua-server", "reject"],
    &["ua-server", "renew"],
    &["ua-server", "trust"],
    &["ua-server", "user"],
];

/// The help of a program or of one of its verbs.
pub(crate) struct Help {
    /// The program and its verbs, such as `ua-gds ca init`.
    pub(crate) words: Vec<String>,
    pub(crate) text: String,
}

impl Help {
    /// Returns the help of each program in the folder and of each verb, in the order of the
    /// reference page.
    ///
    /// # Errors
    /// Returns an error if a program does not run.
    pub(crate) fn all(programs: &Path) -> anyhow::Result<Vec<Self>> {
        let mut all = Vec::new();
        for name in links::BRIDGES.into_iter().chain(links::NAMES) {
            add(programs, &[name], &mut all)?;
            for words in FURTHER.iter().filter(|words| words.first() == Some(&name)) {
                add(programs, words, &mut all)?;
            }
        }
        Ok(all)
    }

    /// Returns the verbs that the help text lists, without `help`.
    pub(crate) fn verbs(&self) -> Vec<&str> {
        let mut verbs = verbs(&self.text);
        let typed: Vec<&str> = self.words.iter().map(String::as_str).collect();
        let further = FURTHER.iter().filter_map(|words| words.split_last());
        verbs.extend(
            further
                .filter(|(_, before)| **before == typed)
                .map(|(verb, _)| *verb),
        );
        verbs
    }

    /// Returns the parts of the text.
    pub(crate) fn parts(&self) -> HelpParts<'_> {
        HelpParts::of(&self.text)
    }
}

fn add(programs: &Path, words: &[&str], all: &mut Vec<Help>) -> anyhow::Result<()> {
    let text = output(programs, &[words, &["--help"]].concat())?;
    let below: Vec<String> = verbs(&text).into_iter().map(str::to_owned).collect();
    all.push(Help {
        words: words.iter().map(|word| (*word).to_owned()).collect(),
        text,
    });
    for verb in &below {
        add(programs, &[words, &[verb]].concat(), all)?;
    }
    Ok(())
}

/// Returns the verbs that a help text lists, without `help`.
fn verbs(help: &str) -> Vec<&str> {
    let lines = help.lines().skip_while(|line| *line != "Commands:").skip(1);
    let verbs = lines.map_while(|line| line.split_whitespace().next());
    verbs.filter(|verb| *verb != "help").collect()
}

/// Returns the output of a program without the `UA_*` and ROS variables, which help texts show.
///
/// # Errors
/// Returns an error if the program does not start or fails.
pub(crate) fn output(programs: &Path, words: &[&str]) -> anyhow::Result<String> {
    let (program, arguments) = words.split_first().context("a program is named")?;
    let mut command = Command::new(programs.join(program));
    command.args(arguments).env_clear();
    let output = command
        .output()
        .with_context(|| format!("{} does not start", line(&command)))?;
    ensure!(
        output.status.success(),
        "{} ended with {}",
        line(&command),
        output.status
    );
    String::from_utf8(output.stdout).with_context(|| line(&command))
}

/// The parts of a help text.
#[derive(Debug, Default, PartialEq, Eq)]
pub(crate) struct HelpParts<'a> {
    /// The paragraphs before and after the sections.
    pub(crate) about: Vec<&'a str>,
    pub(crate) usage: &'a str,
    /// Sections such as `Options`, with their items.
    pub(crate) sections: Vec<(&'a str, Vec<HelpItem<'a>>)>,
}

/// An argument, option or verb with its explanation.
#[derive(Debug, Default, PartialEq, Eq)]
pub(crate) struct HelpItem<'a> {
    /// The argument as it is typed, such as `-o, --out <FILE>`.
    pub(crate) head: &'a str,
    pub(crate) text: Vec<&'a str>,
}

/// Continuation lines of an item are indented at least so far.
const BODY: usize = 8;

impl<'a> HelpParts<'a> {
    fn of(help: &'a str) -> Self {
        let mut parts = Self::default();
        let mut in_section = false;
        for line in help.lines().map(str::trim_end) {
            let text = line.trim_start();
            let indent = line.len() - text.len();
            if text.is_empty() {
                continue;
            }
            if let Some(usage) = line.strip_prefix("Usage: ") {
                parts.usage = usage;
                in_section = false;
            } else if let Some(title) = line.strip_suffix(':').filter(|title| !title.contains(' '))
            {
                parts.sections.push((title, Vec::new()));
                in_section = true;
            } else if indent == 0 || !in_section {
                parts.about.push(text);
                in_section = false;
            } else if let Some((_, items)) = parts.sections.last_mut() {
                match items.last_mut() {
                    Some(item) if indent >= BODY => item.text.push(text),
                    _ => items.push(HelpItem::of(text)),
                }
            }
        }
        parts
    }

    /// Returns the options, each with its long name and its values, if there is a list of them.
    pub(crate) fn options(&self) -> impl Iterator<Item = (&'a str, &HelpItem<'a>)> {
        let options = self
            .sections
            .iter()
            .filter(|(title, _)| *title != "Commands");
        let items = options.flat_map(|(_, items)| items);
        items.filter_map(|item| Some((item.long_name()?, item)))
    }
}

impl<'a> HelpItem<'a> {
    fn of(line: &'a str) -> Self {
        match line.split_once("  ") {
            Some((head, text)) => Self {
                head,
                text: vec![text.trim_start()],
            },
            None => Self {
                head: line,
                text: Vec::new(),
            },
        }
    }

    fn long_name(&self) -> Option<&'a str> {
        let mut words = self.head.split([' ', ',', '=', '[']);
        words.find(|word| word.starts_with("--") && word.len() > 2)
    }

    /// Returns whether a value follows the option.
    pub(crate) fn takes_value(&self) -> bool {
        self.head.contains('<')
    }

    /// Returns the values that the program accepts, if the help lists them.
    pub(crate) fn values(&self) -> Vec<&'a str> {
        for text in &self.text {
            if let Some((_, list)) = text.split_once("[possible values: ") {
                let list = list.split(']').next().unwrap_or_default();
                return list.split(", ").collect();
            }
        }
        let listed = self
            .text
            .iter()
            .skip_while(|text| **text != "Possible values:");
        let listed = listed.skip(1).map_while(|text| text.strip_prefix("- "));
        listed
            .filter_map(|text| text.split([':', ' ']).next())
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const LONG: &str = "\
Carries topics.

More about it: a list.

Usage: bridge [OPTIONS] [MAPPING]

Arguments:
  [MAPPING]
          The mapping

          [env: UA_MAPPING=]

Options:
      --check
          Check the mapping

      --log <FORMAT>
          How log lines look

          Possible values:
          - text: Lines for people
          - json: One object a line

          [default: text]

  -h, --help
          Print help

`bridge simulate --help`: devices
";

    const SHORT: &str = "\
Keys

Usage: tool keys [OPTIONS] <FILE>

Commands:
  add   Adds a key
  help  Print this message

Options:
      --policy <POLICY>  The policy [default: a] [possible values: a, b]
  -n, --next             Appends
";

    #[test]
    fn a_long_help_has_paragraphs_and_items_with_lines() {
        let parts = HelpParts::of(LONG);
        assert_eq!(
            parts.about,
            [
                "Carries topics.",
                "More about it: a list.",
                "`bridge simulate --help`: devices"
            ]
        );
        assert_eq!(parts.usage, "bridge [OPTIONS] [MAPPING]");
        let titles: Vec<&str> = parts.sections.iter().map(|(title, _)| *title).collect();
        assert_eq!(titles, ["Arguments", "Options"]);
        let options: Vec<_> = parts.options().collect();
        let names: Vec<&str> = options.iter().map(|(name, _)| *name).collect();
        assert_eq!(names, ["--check", "--log", "--help"]);
        assert!(!options[0].1.takes_value() && options[1].1.takes_value());
        assert_eq!(options[1].1.values(), ["text", "json"]);
        assert_eq!(options[2].1.text, ["Print help"]);
    }

    #[test]
    fn a_short_help_has_an_item_in_each_line() {
        let parts = HelpParts::of(SHORT);
        let options: Vec<_> = parts.options().collect();
        assert_eq!(options[0].0, "--policy");
        assert_eq!(options[0].1.values(), ["a", "b"]);
        assert_eq!(options[1].1.text, ["Appends"]);
        assert_eq!(verbs(SHORT), ["add"]);
    }
}
