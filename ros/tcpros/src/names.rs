//! Graph resource names: resolves `chatter`, `/chatter`, `~chatter` and remappings.

use thiserror::Error;

/// Resolves names as one node sees them.
#[derive(Clone, Debug)]
pub(crate) struct NameResolver {
    node: String,
    namespace: String,
    remappings: Vec<(String, String)>,
}

impl NameResolver {
    /// Fails if the node's own name or namespace or a remapping is not a graph name.
    pub(crate) fn new(
        name: &str,
        namespace: &str,
        remappings: &[(String, String)],
    ) -> Result<Self, ResourceNameError> {
        let base = name.strip_prefix('/').unwrap_or(name);
        if base.contains('/') {
            return Err(ResourceNameError::NodeName(name.to_owned()));
        }
        let namespace = match namespace.trim_matches('/') {
            "" => "/".to_owned(),
            inner => format!("/{inner}"),
        };
        check(base)?;
        check(&namespace)?;
        let mut names = Self {
            node: join(&namespace, base),
            namespace,
            remappings: Vec::new(),
        };
        let resolved = remappings
            .iter()
            .map(|(from, to)| Ok((names.expand(from)?, names.expand(to)?)));
        names.remappings = resolved.collect::<Result<_, ResourceNameError>>()?;
        Ok(names)
    }

    /// Returns the resolved name of the node itself.
    pub(crate) fn node(&self) -> &str {
        &self.node
    }

    /// Returns the resolved name of a topic, with remappings applied.
    pub(crate) fn resolve(&self, name: &str) -> Result<String, ResourceNameError> {
        let name = self.expand(name)?;
        let remapped = self.remappings.iter().find(|(from, _)| *from == name);
        Ok(remapped.map_or(name, |(_, to)| to.clone()))
    }

    /// Returns a name for the upward search of the master. The name is unchanged, except that a
    /// private or remapped name is resolved.
    pub(crate) fn searched(&self, name: &str) -> Result<String, ResourceNameError> {
        let resolved = self.resolve(name)?;
        if name.starts_with(['~', '/']) || resolved != self.expand(name)? {
            Ok(resolved)
        } else {
            Ok(name.to_owned())
        }
    }

    fn expand(&self, name: &str) -> Result<String, ResourceNameError> {
        check(name)?;
        canonical(&full(name, &self.node, &self.namespace))
            .ok_or_else(|| ResourceNameError::Invalid(name.to_owned()))
    }
}

/// Resolves a parameter name relative to the calling node, `/` included. A master uses this
/// function, because it knows no remappings and accepts more characters than graph names have.
pub(crate) fn of_caller(name: &str, caller: &str) -> Result<String, ResourceNameError> {
    if name.is_empty() {
        return Err(ResourceNameError::Invalid(name.to_owned()));
    }
    let namespace = caller
        .rsplit_once('/')
        .map_or("", |(namespace, _)| namespace);
    let clean = canonical(&full(name, caller, namespace));
    Ok(clean.unwrap_or_else(|| "/".to_owned()))
}

fn full(name: &str, node: &str, namespace: &str) -> String {
    if name.starts_with('/') {
        name.to_owned()
    } else if let Some(private) = name.strip_prefix('~') {
        join(node, private)
    } else {
        join(namespace, name)
    }
}

/// Returns a full name without double or trailing slashes, or `None` for the root.
fn canonical(full: &str) -> Option<String> {
    let mut clean = String::with_capacity(full.len());
    for part in full.split('/').filter(|part| !part.is_empty()) {
        clean.push('/');
        clean.push_str(part);
    }
    (!clean.is_empty()).then_some(clean)
}

/// Error for an invalid graph resource name.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
#[non_exhaustive]
pub enum ResourceNameError {
    /// Not a letter, `/` or `~` followed by letters, digits, `_` and `/`.
    #[error(
        "`{0}` is not a ROS name: use letters, digits, `_` and `/`, beginning with a letter, `/` or `~`"
    )]
    Invalid(String),
    /// The name of a node contains no `/`; the part before it belongs to the namespace.
    #[error("`{0}` is not a node name: move the part before the last `/` into the namespace")]
    NodeName(String),
}

fn join(namespace: &str, name: &str) -> String {
    format!(
        "{}/{}",
        namespace.trim_end_matches('/'),
        name.trim_start_matches('/')
    )
}

/// Checks that a name is a valid ROS name (`wiki.ros.org/Names`).
pub(crate) fn check(name: &str) -> Result<(), ResourceNameError> {
    let mut bytes = name.bytes();
    let head = bytes
        .next()
        .is_some_and(|b| b.is_ascii_alphabetic() || b == b'/' || b == b'~');
    if head && bytes.all(|b| b.is_ascii_alphanumeric() || b == b'_' || b == b'/') {
        Ok(())
    } else {
        Err(ResourceNameError::Invalid(name.to_owned()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names(remappings: &[(&str, &str)]) -> NameResolver {
        let owned: Vec<_> = remappings
            .iter()
            .map(|(a, b)| ((*a).to_owned(), (*b).to_owned()))
            .collect();
        NameResolver::new("cell", "line1/", &owned).unwrap()
    }

    #[test]
    fn names_resolve_as_the_ros_wiki_tables_them() {
        let names = names(&[]);
        assert_eq!(names.node(), "/line1/cell");
        assert_eq!(names.resolve("chatter").unwrap(), "/line1/chatter");
        assert_eq!(names.resolve("/chatter").unwrap(), "/chatter");
        assert_eq!(names.resolve("~chatter").unwrap(), "/line1/cell/chatter");
        assert_eq!(names.resolve("a//b/").unwrap(), "/line1/a/b");
        assert_eq!(NameResolver::new("cell", "", &[]).unwrap().node(), "/cell");
        assert_eq!(
            NameResolver::new("/cell", "/", &[])
                .unwrap()
                .resolve("a")
                .unwrap(),
            "/a"
        );
    }

    #[test]
    fn a_remapping_holds_for_every_spelling_of_its_name() {
        let names = names(&[("chatter", "/talk")]);
        assert_eq!(names.resolve("chatter").unwrap(), "/talk");
        assert_eq!(names.resolve("/line1/chatter").unwrap(), "/talk");
        assert_eq!(names.resolve("/chatter").unwrap(), "/chatter");
    }

    #[test]
    fn a_private_name_can_be_remapped_and_be_the_target() {
        let names = names(&[("~out", "/line2/in"), ("log", "~log")]);
        assert_eq!(names.resolve("~out").unwrap(), "/line2/in");
        assert_eq!(names.resolve("/line1/cell/out").unwrap(), "/line2/in");
        assert_eq!(names.resolve("log").unwrap(), "/line1/cell/log");
        assert_eq!(names.resolve("~/a/").unwrap(), "/line1/cell/a");
    }

    #[test]
    fn only_a_relative_name_that_is_not_remapped_is_searched_upwards() {
        let names = names(&[("gains", "/other/gains")]);
        assert_eq!(names.searched("limits/low").unwrap(), "limits/low");
        assert_eq!(names.searched("gains").unwrap(), "/other/gains");
        assert_eq!(names.searched("~limits").unwrap(), "/line1/cell/limits");
        assert_eq!(names.searched("/limits").unwrap(), "/limits");
    }

    #[test]
    fn what_is_no_name_is_refused() {
        let names = names(&[]);
        for bad in ["", "/", "1a", "a b", "a-b", "ä", "_a"] {
            assert!(names.resolve(bad).is_err(), "{bad}");
        }
        assert_eq!(
            NameResolver::new("a/b", "", &[]).unwrap_err(),
            ResourceNameError::NodeName("a/b".to_owned())
        );
    }
}
