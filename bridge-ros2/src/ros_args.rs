//! The arguments after `--ros-args` on a command line, as `ros2 run` and launch files pass them
//! (design.ros2.org, "ROS Command Line Arguments"): the node's name and namespace, and the only
//! parameter of a bridge.

use bridge_node::{Failure, FailureKind};

/// The settings of a node in ROS arguments.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(crate) struct RosArgs {
    /// `-r __node:=NAME`.
    pub(crate) name: Option<String>,
    /// `-r __ns:=/NAMESPACE`.
    pub(crate) namespace: Option<String>,
    /// `--enclave /NAME`.
    pub(crate) enclave: Option<String>,
    /// `-p use_sim_time:=true`.
    pub(crate) use_sim_time: Option<bool>,
}

impl RosArgs {
    /// Parses the words after `--ros-args`. Later words take precedence.
    ///
    /// # Errors
    /// An argument that a bridge does not support, such as another name for a topic: it would be
    /// ignored silently otherwise.
    pub(crate) fn parse<S: AsRef<str>>(words: &[S]) -> Result<Self, Failure> {
        let mut found = Self::default();
        let mut words = words.iter().map(AsRef::as_ref);
        while let Some(word) = words.next() {
            let rule = match word {
                "-r" | "--remap" | "-p" | "--param" => words.next().ok_or_else(|| {
                    usage(format!(
                        "{word}: expected a rule such as NAME:=VALUE after it"
                    ))
                })?,
                "-e" | "--enclave" => {
                    let name = words.next().ok_or_else(|| {
                        usage(format!("{word}: expected the name of an enclave after it"))
                    })?;
                    found.enclave = Some(name.to_owned());
                    continue;
                }
                "--ros-args" => continue,
                "--" => break,
                other => {
                    return Err(usage(format!(
                        "{other}: unknown; a bridge accepts -r, -p and --enclave after --ros-args"
                    )));
                }
            };
            let (name, value) = rule.split_once(":=").ok_or_else(|| {
                usage(format!(
                    "{word} {rule}: expected a rule such as NAME:=VALUE"
                ))
            })?;
            let is_parameter = word == "-p" || word == "--param";
            match (is_parameter, name) {
                (false, "__node" | "__name") => found.name = Some(value.to_owned()),
                (false, "__ns") => found.namespace = Some(value.to_owned()),
                (true, "use_sim_time") => {
                    // Spelled as in YAML.
                    found.use_sim_time = Some(match value.to_ascii_lowercase().as_str() {
                        "true" => true,
                        "false" => false,
                        _ => {
                            let why = format!("use_sim_time is true or false, not {value}");
                            return Err(usage(why));
                        }
                    });
                }
                (false, _) => {
                    return Err(usage(format!(
                        "{word} {rule}: a bridge accepts __node and __ns only; the mapping names the topics"
                    )));
                }
                (true, _) => {
                    return Err(usage(format!(
                        "{word} {rule}: use_sim_time is the only parameter of a bridge"
                    )));
                }
            }
        }
        Ok(found)
    }
}

/// Returns the failure for a wrong command line.
pub(crate) fn usage(message: String) -> Failure {
    Failure::new(FailureKind::Usage, message)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_ros2_run_gives_a_node_is_taken() {
        let words =
            "-r __node:=left -r __ns:=/cell --enclave /cell/left -p use_sim_time:=True -- rest";
        let words: Vec<&str> = words.split(' ').collect();
        assert_eq!(
            RosArgs::parse(&words).unwrap(),
            RosArgs {
                name: Some("left".into()),
                namespace: Some("/cell".into()),
                enclave: Some("/cell/left".into()),
                use_sim_time: Some(true),
            }
        );
    }

    #[test]
    fn what_a_bridge_cannot_obey_is_refused() {
        for (words, why) in [
            ("-r /chatter:=/news", "mapping"),
            ("-p rate:=3", "use_sim_time"),
            ("-p use_sim_time:=soon", "soon"),
            ("-r", "NAME:=VALUE"),
            ("-r __node", "NAME:=VALUE"),
            ("--enclave", "the name of an enclave"),
            ("--params-file x.yaml", "--params-file"),
        ] {
            let words: Vec<&str> = words.split(' ').collect();
            let error = RosArgs::parse(&words).unwrap_err().to_string();
            assert!(error.contains(why), "{error}");
        }
    }
}
