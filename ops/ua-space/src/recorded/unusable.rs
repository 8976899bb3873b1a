//! The values of a recording that cannot be sent again.

/// The reason why a value of the recording cannot be sent again.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum UnusableValue {
    /// The channel has the model of a robot for viewers (`--model`).
    Model,
    /// The channel is not of the space.
    Foreign,
    /// The channel has no description of its topic.
    Undescribed,
    /// JSON has no types for some values, as for structures.
    Untyped,
    /// The value does not match the description of its topic.
    Mismatch,
}

impl UnusableValue {
    /// Returns the text for output.
    pub(crate) const fn label(self) -> &'static str {
        match self {
            Self::Model => "models of robots, which are for viewers and no values of the space",
            Self::Foreign => "values of channels that `ua-space record` did not write",
            Self::Undescribed => "values of channels without the description of their topic",
            Self::Untyped => {
                "values that this recording has without their types; a .pcapng file has them"
            }
            Self::Mismatch => "values that do not match the description of their topic",
        }
    }
}
