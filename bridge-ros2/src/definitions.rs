//! Message definitions: those built in, and those of the ROS installation the program was started in.

use std::fs::File;
use std::io::Read;
use std::path::PathBuf;
use std::sync::Arc;

use messages::{DefinitionError, Dialect, MessageType, Registry, TypeName};
use tracing::{info, warn};
use uadp::BuiltinType;

/// Finds message types by name; a type once found stays.
#[derive(Debug)]
pub(crate) struct Definitions {
    registry: Registry,
    /// Folders that hold `share/<package>/msg/<Name>.msg`, first match wins.
    prefixes: Vec<PathBuf>,
}

impl Definitions {
    /// With the built-in definitions and the prefixes of a ROS 2 installation, as `AMENT_PREFIX_PATH` lists them.
    pub(crate) fn new(prefixes: Vec<PathBuf>) -> Self {
        Self {
            registry: Registry::bundle(Dialect::Ros2),
            prefixes,
        }
    }

    /// The type of that name with all it needs.
    ///
    /// A type that is not built in is read from the prefixes: a few small files, once.
    ///
    /// # Errors
    /// [`DefinitionError`].
    pub(crate) fn get(&mut self, name: &TypeName) -> Result<Arc<MessageType>, DefinitionError> {
        for _ in 0..MAX_FILES {
            match self.registry.get(name) {
                Err(DefinitionError::Unknown {
                    name: missing,
                    needed_by,
                    suggestion,
                }) => {
                    let Some((file, text)) = self.find(&missing) else {
                        return Err(DefinitionError::Unknown {
                            name: missing,
                            needed_by,
                            suggestion,
                        });
                    };
                    self.registry.add(&missing, &text)?;
                    info!(message_type = %missing, file = %file.display(), "definition read");
                }
                found => return found,
            }
        }
        self.registry.get(name)
    }

    /// The ROS type that carries one value of that type, and nothing else.
    pub(crate) fn standard_type(&self, builtin: BuiltinType, array: bool) -> Option<TypeName> {
        self.registry.standard_type(builtin, array)
    }

    fn find(&self, name: &TypeName) -> Option<(PathBuf, String)> {
        self.prefixes.iter().find_map(|prefix| {
            // Neither part of a type name can hold a separator or a dot.
            let file = prefix
                .join("share")
                .join(name.package())
                .join("msg")
                .join(format!("{}.msg", name.name()));
            let mut text = String::new();
            let read = File::open(&file)
                .ok()?
                .take(MAX_BYTES)
                .read_to_string(&mut text);
            match read {
                Ok(_) => Some((file, text)),
                Err(error) => {
                    warn!(file = %file.display(), %error, "definition not readable");
                    None
                }
            }
        })
    }
}

/// More types than any message needs.
const MAX_FILES: usize = 512;
/// More than any `.msg` file has.
const MAX_BYTES: u64 = 1 << 20;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_type_that_is_not_built_in_is_read_from_the_ros_installation() {
        let prefix = std::env::temp_dir().join(format!("definitions-{}", std::process::id()));
        let folder = prefix.join("share/robot_msgs/msg");
        std::fs::create_dir_all(&folder).unwrap();
        std::fs::write(folder.join("Arm.msg"), "robot_msgs/Joint[] joints\n").unwrap();
        std::fs::write(folder.join("Joint.msg"), "string name\nfloat64 angle\n").unwrap();

        let found = Definitions::new(vec![prefix.clone()]).get(&"robot_msgs/Arm".parse().unwrap());
        std::fs::remove_dir_all(&prefix).unwrap();
        assert_eq!(found.unwrap().leaves()[0].path, "joints");
    }

    #[test]
    fn a_type_nobody_defines_is_named_in_the_error() {
        let error = Definitions::new(vec![])
            .get(&"robot_msgs/Arm".parse().unwrap())
            .unwrap_err();
        assert!(error.to_string().contains("robot_msgs/Arm"), "{error}");
    }
}
