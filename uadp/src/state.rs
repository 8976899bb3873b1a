//! The PubSubState of connections, groups, writers and readers (OPC 10000-14, 6.2.1).

/// State of a PubSub component, with the values of the enumeration (OPC 10000-14, 6.2.1, Table 1).
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default)]
#[repr(u8)]
pub enum PubSubState {
    /// Configured, but not enabled.
    #[default]
    Disabled = 0,
    /// Enabled, but its parent is Disabled or Paused.
    Paused = 1,
    /// Working.
    Operational = 2,
    /// Enabled, but in error.
    Error = 3,
    /// Enabled, and becoming Operational.
    PreOperational = 4,
}

/// Event that changes the state of a component (OPC 10000-14, 6.2.1, Table 2).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum StateEvent {
    /// The component is enabled, below a parent in the given state.
    Enable {
        /// State of the parent component.
        parent: PubSubState,
    },
    /// The component is disabled.
    Disable,
    /// The parent changed to this state.
    Parent(PubSubState),
    /// The component is ready: network and keys are available, or a reader received its first key
    /// frame or event.
    Ready,
    /// An error occurred.
    Fail,
    /// The error is resolved, and the component is Operational again.
    Resolve,
    /// The error is resolved, but the component has to become Operational again.
    Restart,
}

/// Error of an event that is not valid in the state.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, thiserror::Error)]
#[error("{event:?} refused in state {state:?}")]
pub struct StateRefused {
    /// The state, which is unchanged.
    pub state: PubSubState,
    /// The rejected event.
    pub event: StateEvent,
}

impl PubSubState {
    /// Returns the state of an enumeration value, or `None` above 4.
    #[must_use]
    pub const fn from_value(value: u8) -> Option<Self> {
        Some(match value {
            0 => Self::Disabled,
            1 => Self::Paused,
            2 => Self::Operational,
            3 => Self::Error,
            4 => Self::PreOperational,
            _ => return None,
        })
    }

    /// Returns the state after `event`: the transitions of OPC 10000-14, 6.2.1, Table 2. Parent
    /// states that the table does not mention, such as Error, do not change the state.
    ///
    /// # Errors
    /// [`StateRefused`] for transitions that are not in the table: `Enable` outside of Disabled,
    /// `Disable` in Disabled, `Ready` outside of PreOperational, `Fail` in Disabled, Paused and
    /// Error, `Resolve` and `Restart` outside of Error.
    pub const fn next(self, event: StateEvent) -> Result<Self, StateRefused> {
        Ok(match (self, event) {
            (Self::Disabled, StateEvent::Enable { parent }) => match parent {
                Self::Disabled | Self::Paused => Self::Paused,
                Self::Operational | Self::Error | Self::PreOperational => Self::PreOperational,
            },
            (
                Self::Paused | Self::Operational | Self::Error | Self::PreOperational,
                StateEvent::Disable,
            ) => Self::Disabled,
            (Self::Paused, StateEvent::Parent(Self::Operational))
            | (Self::Error, StateEvent::Restart) => Self::PreOperational,
            (
                Self::Operational | Self::Error | Self::PreOperational,
                StateEvent::Parent(Self::Disabled | Self::Paused),
            ) => Self::Paused,
            (Self::PreOperational, StateEvent::Ready) | (Self::Error, StateEvent::Resolve) => {
                Self::Operational
            }
            (Self::PreOperational | Self::Operational, StateEvent::Fail) => Self::Error,
            (state, StateEvent::Parent(_)) => state,
            (state, event) => return Err(StateRefused { state, event }),
        })
    }

    /// Returns true if the component takes part in the communication: in Operational,
    /// PreOperational, and Error, because received messages can resolve an Error.
    #[must_use]
    pub const fn is_active(self) -> bool {
        match self {
            Self::Disabled | Self::Paused => false,
            Self::Operational | Self::Error | Self::PreOperational => true,
        }
    }
}

/// State of a component below a parent, such as a DataSetWriter below its WriterGroup below its
/// PubSubConnection (OPC 10000-14, 6.2.1, Figure 22).
///
/// The owner passes each change of a parent to its children with [`set_parent`](Self::set_parent),
/// from the top down.
/// ```
/// use uadp::{PubSubState, StateEvent, StateMachine};
///
/// let mut connection = StateMachine::new(PubSubState::Operational); // below PublishSubscribe, the root
/// let mut group = StateMachine::new(connection.state());
/// let mut writer = StateMachine::new(group.state());
///
/// assert_eq!(writer.enable(), Ok(PubSubState::Paused)); // its group is Disabled
/// connection.enable()?;
/// connection.handle(StateEvent::Ready)?;
/// group.set_parent(connection.state());
/// group.enable()?;
/// assert_eq!(writer.set_parent(group.state()), PubSubState::Paused); // its group is PreOperational
/// group.handle(StateEvent::Ready)?;
/// assert_eq!(writer.set_parent(group.state()), PubSubState::PreOperational);
/// writer.handle(StateEvent::Ready)?;
///
/// connection.disable()?;
/// group.set_parent(connection.state());
/// assert_eq!(writer.set_parent(group.state()), PubSubState::Paused);
/// # Ok::<(), uadp::StateRefused>(())
/// ```
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct StateMachine {
    state: PubSubState,
    parent: PubSubState,
}

impl StateMachine {
    /// Creates a component in Disabled, below a parent in the given state.
    #[must_use]
    pub const fn new(parent: PubSubState) -> Self {
        Self {
            state: PubSubState::Disabled,
            parent,
        }
    }

    /// Handles the event, and returns the new state.
    ///
    /// # Errors
    /// As [`PubSubState::next`]; the state is then unchanged.
    pub const fn handle(&mut self, event: StateEvent) -> Result<PubSubState, StateRefused> {
        match self.state.next(event) {
            Ok(state) => {
                self.state = state;
                Ok(state)
            }
            Err(refused) => Err(refused),
        }
    }

    /// Enables the component, which becomes Paused or PreOperational.
    ///
    /// # Errors
    /// [`StateRefused`] if the component is enabled already.
    pub const fn enable(&mut self) -> Result<PubSubState, StateRefused> {
        self.handle(StateEvent::Enable {
            parent: self.parent,
        })
    }

    /// Disables the component.
    ///
    /// # Errors
    /// [`StateRefused`] if the component is disabled already.
    pub const fn disable(&mut self) -> Result<PubSubState, StateRefused> {
        self.handle(StateEvent::Disable)
    }

    /// Sets the state of the parent, and returns the resulting state of the component.
    pub const fn set_parent(&mut self, parent: PubSubState) -> PubSubState {
        self.parent = parent;
        self.settle(StateEvent::Parent(parent));
        self.state
    }

    /// Handles the event. Returns false if the event is not valid in the state.
    pub(crate) const fn settle(&mut self, event: StateEvent) -> bool {
        self.handle(event).is_ok()
    }

    /// Returns the state of the component.
    #[must_use]
    pub const fn state(&self) -> PubSubState {
        self.state
    }

    /// Returns the last known state of the parent.
    #[must_use]
    pub const fn parent(&self) -> PubSubState {
        self.parent
    }
}
