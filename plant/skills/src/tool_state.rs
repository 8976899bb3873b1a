//! The state of a tool changer.

use crate::choosing::Attachment;

/// The state of a tool changer, as its component shows it.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct ToolState {
    /// The pose of the tool plate in the frame of the flange.
    pub plate: [f64; 6],
    /// The ApplicationUri of the attached tool; empty for none, `None` if it is unknown.
    pub current: Option<String>,
    /// The endpoint of the robot that carries the changer; empty if it is unknown.
    pub mover: String,
}

impl ToolState {
    /// Returns the ApplicationUri of the attached tool; `None` for none, and if it is unknown.
    pub(crate) fn tool(&self) -> Option<&str> {
        self.current.as_deref().filter(|tool| !tool.is_empty())
    }

    /// Returns whether the tool changer is at a robot, given by its ApplicationUri and its
    /// endpoint.
    #[must_use]
    pub fn is_at(&self, (application_uri, endpoint): (&str, &str)) -> bool {
        let is_it = self.mover == application_uri || is_same_endpoint(&self.mover, endpoint);
        !self.mover.is_empty() && is_it
    }

    /// Returns what a component is attached to by this tool changer. The component is given by its
    /// ApplicationUri, and by its endpoint if that is known.
    pub fn attachment(&self, component: &str, endpoint: Option<&str>) -> Attachment {
        let Some(tool) = self.tool() else {
            return Attachment::None;
        };
        let is_at_mover = |endpoint: &str| is_same_endpoint(endpoint, &self.mover);
        if tool == component {
            Attachment::AtRobot
        } else if self.mover == component || endpoint.is_some_and(is_at_mover) {
            Attachment::CarriesTool
        } else {
            Attachment::None
        }
    }
}

/// Compares URLs of endpoints, which may end with a slash.
pub(crate) fn is_same_endpoint(a: &str, b: &str) -> bool {
    a.trim_end_matches('/') == b.trim_end_matches('/')
}
