//! The properties of a package in `package.xml`.

use std::io::Read as _;
use std::path::Path;

use messages::Dialect;

/// A folder with definitions.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct PackageFolder {
    pub(crate) name: String,
    /// The ROS version of the package, if `package.xml` names it.
    pub(crate) dialect: Option<Dialect>,
}

impl PackageFolder {
    /// Reads the `package.xml` of a folder; without it, the package has the name of the folder.
    pub(crate) fn of(folder: &Path) -> Self {
        let named = folder.file_name().map(|name| name.to_string_lossy());
        let mut package = Self {
            name: named.unwrap_or_default().into_owned(),
            dialect: None,
        };
        let mut text = String::new();
        let file = crate::open(&folder.join(MANIFEST));
        if file
            .and_then(|file| file.take(MOST_BYTES).read_to_string(&mut text))
            .is_err()
        {
            return package;
        }
        if let Some((_, rest)) = text.split_once("<name>")
            && let Some((name, _)) = rest.split_once("</name>")
        {
            package.name = name.trim().to_owned();
        }
        package.dialect = match (text.contains("catkin"), text.contains("ament_")) {
            (true, false) => Some(Dialect::Ros1),
            (false, true) => Some(Dialect::Ros2),
            (true, true) | (false, false) => None,
        };
        package
    }
}

pub(crate) const MANIFEST: &str = "package.xml";
const MOST_BYTES: u64 = 1 << 20;
