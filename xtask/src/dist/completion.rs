//! Completions for shells from the help texts of the programs. `ua-space` has its own, which know
//! the names of the running space.

use std::fmt::Write as _;

use crate::help::Help;

/// The completion scripts of a program.
pub(crate) struct Scripts {
    pub(crate) bash: String,
    pub(crate) zsh: String,
    pub(crate) fish: String,
}

/// Returns the scripts of the program whose help and verbs are `all`.
pub(crate) fn scripts(program: &str, all: &[&Help]) -> Scripts {
    Scripts {
        bash: bash(program, all),
        zsh: zsh(program, all),
        fish: fish(program, all),
    }
}

/// Returns the verbs before the completed word, with a space before each.
fn path(help: &Help) -> String {
    let verbs = help.words.iter().skip(1);
    verbs.map(|verb| format!(" {verb}")).collect()
}

/// Returns the verbs and options that may follow.
fn words(help: &Help) -> String {
    let parts = help.parts();
    let options = parts.options().map(|(name, _)| name);
    let words: Vec<&str> = help.verbs().into_iter().chain(options).collect();
    words.join(" ")
}

/// Returns the options with values, and the values that the program accepts, if they are listed.
fn values(help: &Help) -> Vec<(&str, Vec<&str>)> {
    let parts = help.parts();
    let options = parts.options().filter(|(_, item)| item.takes_value());
    options.map(|(name, item)| (name, item.values())).collect()
}

/// Returns the branches of a `case` over the verbs and the word before, the same in both shells.
fn cases(all: &[&Help], offer: impl Fn(&str) -> String) -> String {
    let mut cases = String::new();
    for help in all {
        for (option, values) in values(help) {
            let offered = match values.is_empty() {
                true => "return 1".to_owned(),
                false => offer(&values.join(" ")),
            };
            // Writing to a string does not fail.
            let _written = writeln!(cases, "    \"{} {option}\") {offered} ;;", path(help));
        }
    }
    for help in all {
        let _written = writeln!(
            cases,
            "    \"{} \"*) {} ;;",
            path(help),
            offer(&words(help))
        );
    }
    cases
}

/// Returns the branches that follow the verbs of a command line.
fn steps(all: &[&Help]) -> String {
    let verbs = all.iter().filter(|help| help.words.len() > 1);
    let paths: Vec<String> = verbs.map(|help| format!("\"{}\"", path(help))).collect();
    match paths.is_empty() {
        true => String::new(),
        false => format!(
            "    case \"$verbs $word\" in {}) verbs=\"$verbs $word\" ;; esac\n",
            paths.join("|")
        ),
    }
}

fn function(program: &str) -> String {
    format!("_{}", program.replace('-', "_"))
}

fn bash(program: &str, all: &[&Help]) -> String {
    let function = function(program);
    // Cases with the longest verbs come first, because a pattern ends with any text.
    let mut sorted = all.to_vec();
    sorted.sort_by_key(|help| std::cmp::Reverse(help.words.len()));
    let cases = cases(&sorted, |words| {
        format!("mapfile -t COMPREPLY < <(compgen -W \"{words}\" -- \"$typed\")")
    });
    format!(
        "# Completion of {program} for bash.\n{function}() {{\n  local typed=\"${{COMP_WORDS[COMP_CWORD]}}\" \
         verbs=\"\" word\n  COMPREPLY=()\n  for word in \"${{COMP_WORDS[@]:1:COMP_CWORD-1}}\"; do\n    \
         [[ \"$word\" == -* ]] && break\n{}  done\n  case \"$verbs ${{COMP_WORDS[COMP_CWORD-1]}}\" in\n{cases}  \
         esac\n}}\ncomplete -o default -F {function} {program}\n",
        steps(all)
    )
}

fn zsh(program: &str, all: &[&Help]) -> String {
    let mut sorted = all.to_vec();
    sorted.sort_by_key(|help| std::cmp::Reverse(help.words.len()));
    let cases = cases(&sorted, |offered| format!("compadd -- {offered}"));
    let cases = cases.replace("return 1", "_files");
    format!(
        "#compdef {program}\nlocal verbs=\"\" word\nfor word in \"${{(@)words[2,CURRENT-1]}}\"; do\n    \
         [[ \"$word\" == -* ]] && break\n{}done\ncase \"$verbs ${{words[CURRENT-1]}}\" in\n{cases}esac\n\
         [[ \"${{words[CURRENT]}}\" == -* ]] || _files\n",
        steps(all)
    )
}

fn fish(program: &str, all: &[&Help]) -> String {
    let mut script = String::new();
    for help in all {
        let verbs: Vec<&str> = help.words.iter().skip(1).map(String::as_str).collect();
        let mut conditions: Vec<String> = verbs
            .iter()
            .map(|verb| format!("__fish_seen_subcommand_from {verb}"))
            .collect();
        let below = help.verbs();
        if !below.is_empty() {
            conditions.push(format!(
                "not __fish_seen_subcommand_from {}",
                below.join(" ")
            ));
        }
        let condition = match conditions.is_empty() {
            true => String::new(),
            false => format!(" -n '{}'", conditions.join("; and ")),
        };
        for verb in below {
            let _written = writeln!(script, "complete -c {program}{condition} -a {verb}");
        }
        let parts = help.parts();
        for (name, item) in parts.options() {
            let about = item.text.first().copied().unwrap_or_default();
            let about = about.replace('\\', "\\\\").replace('\'', "\\'");
            let values = item.values();
            let value = match (item.takes_value(), values.is_empty()) {
                (false, _) => String::new(),
                (true, true) => " -r".to_owned(),
                (true, false) => format!(" -x -a '{}'", values.join(" ")),
            };
            let _written = writeln!(
                script,
                "complete -c {program}{condition} -l {}{value} -d '{about}'",
                name.trim_start_matches('-')
            );
        }
    }
    script
}

#[cfg(test)]
mod tests {
    use std::process::Command;

    use super::*;

    fn help(words: &[&str], text: &str) -> Help {
        Help {
            words: words.iter().map(|word| (*word).to_owned()).collect(),
            text: text.to_owned(),
        }
    }

    /// Returns the candidates of bash for the last word.
    fn completed(script: &str, words: &[&str]) -> Vec<String> {
        let line: Vec<String> = words.iter().map(|word| format!("'{word}'")).collect();
        let typed = format!(
            "{script}\nCOMP_WORDS=({})\nCOMP_CWORD={}\n_ua_tool\nprintf '%s\\n' \"${{COMPREPLY[@]}}\"",
            line.join(" "),
            words.len() - 1
        );
        let output = Command::new("bash").args(["-c", &typed]).output().unwrap();
        assert!(output.stderr.is_empty(), "{output:?}");
        let text = String::from_utf8(output.stdout).unwrap();
        text.lines()
            .map(str::to_owned)
            .filter(|word| !word.is_empty())
            .collect()
    }

    #[test]
    fn verbs_options_and_values_are_offered_where_they_may_stand() {
        let tool = help(
            &["ua-tool"],
            "T\n\nUsage: ua-tool\n\nCommands:\n  ca    C\n  list  L\n  help  H\n\nOptions:\n      \
             --log <FORMAT>  How [possible values: text, json]\n      --pki <DIR>     Where\n",
        );
        let ca = help(
            &["ua-tool", "ca"],
            "C\n\nUsage: ua-tool ca\n\nCommands:\n  init  I\n",
        );
        let init = help(
            &["ua-tool", "ca", "init"],
            "I\n\nUsage: ua-tool ca init\n\nOptions:\n      --days <DAYS>  D\n      --force        F\n",
        );
        let list = help(
            &["ua-tool", "list"],
            "L\n\nUsage: ua-tool list\n\nOptions:\n      --json  J\n",
        );
        let all = [&tool, &ca, &init, &list];
        let scripts = scripts("ua-tool", &all);
        for (line, expected) in [
            (&["ua-tool", ""][..], &["ca", "list", "--log", "--pki"][..]),
            (&["ua-tool", "--l"], &["--log"]),
            (&["ua-tool", "--log", ""], &["text", "json"]),
            (&["ua-tool", "--pki", ""], &[]),
            (&["ua-tool", "ca", ""], &["init"]),
            (&["ua-tool", "ca", "init", "--"], &["--days", "--force"]),
            (&["ua-tool", "ca", "init", "--force", "--d"], &["--days"]),
            (&["ua-tool", "list", "-"], &["--json"]),
        ] {
            assert_eq!(
                completed(&scripts.bash, line),
                expected,
                "{line:?}\n{}",
                scripts.bash
            );
        }
        assert!(
            scripts.zsh.starts_with("#compdef ua-tool\n"),
            "{}",
            scripts.zsh
        );
        let fish = "complete -c ua-tool -n '__fish_seen_subcommand_from list' -l json -d 'J'\n";
        assert!(scripts.fish.contains(fish), "{}", scripts.fish);
    }
}
