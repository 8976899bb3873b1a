//! The docks of the tools in the YAML of the example tool changer.

/// Returns the YAML of the tool changer with each tool in the other tool's dock.
pub(crate) fn swapped_tools(yaml: &str) -> String {
    yaml.replace("number: 1", "number: X")
        .replace("number: 2", "number: 1")
        .replace("number: X", "number: 2")
        .replace("dock: [0.3", "dock: [X")
        .replace("dock: [-0.3", "dock: [0.3")
        .replace("dock: [X", "dock: [-0.3")
}
