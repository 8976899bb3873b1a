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
    /// Enabled, but something is wrong.
    Error = 3,
    /// Enabled, and busy with what it needs to become Operational.
    PreOperational = 4,
}

/// What makes a component change its state (OPC 10000-14, 6.2.1, Table 2).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum StateEvent {
    /// Enabled, below a parent in the given state.
    Enable {
        /// State of the parent component.
        parent: PubSubState,
    },
    /// Disabled.
    Disable,
    /// The parent is now in this state.
    Parent(PubSubState),
    /// The steps to Operational are done: network and keys, or a reader's first key frame or event.
    Ready,
    /// Something is wrong.
    Fail,
    /// Nothing is wrong any more, and the component works again at once.
    Resolve,
    /// Nothing is wrong any more, but the steps to Operational are to be done again.
    Restart,
}

/// The event has no place in the state.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, thiserror::Error)]
#[error("{event:?} refused in state {state:?}")]
pub struct StateRefused {
    /// The state, which stays as it is.
    pub state: PubSubState,
    /// What was to change it.
    pub event: StateEvent,
}

impl PubSubState {
    /// State of a value of the enumeration; `None` above 4.
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

    /// The state after `event`: the transitions of OPC 10000-14, 6.2.1, Table 2. A parent's change that the table does
    /// not name, such as to Error, leaves the state as it is.
    ///
    /// # Errors
    /// [`StateRefused`] for what the table does not have: enabling what is not Disabled, disabling what is, `Ready`
    /// outside of PreOperational, `Fail` in Disabled, Paused and Error, `Resolve` and `Restart` outside of Error.
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

    /// True in the states that take part in the traffic: Operational, PreOperational, and Error, which a component
    /// leaves by what it receives.
    #[must_use]
    pub const fn is_active(self) -> bool {
        match self {
            Self::Disabled | Self::Paused => false,
            Self::Operational | Self::Error | Self::PreOperational => true,
        }
    }
}

/// The state of a component below a parent, such as a DataSetWriter below its WriterGroup below its
/// PubSubConnection (OPC 10000-14, 6.2.1, Figure 22).
///
/// Each change of a parent is told to its children by [`set_parent`](Self::set_parent), from the top down.
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
    /// A component in Disabled, below a parent in the given state.
    #[must_use]
    pub const fn new(parent: PubSubState) -> Self {
        Self {
            state: PubSubState::Disabled,
            parent,
        }
    }

    /// Takes the event; the new state.
    ///
    /// # Errors
    /// As [`PubSubState::next`]; the state is then as before.
    pub const fn handle(&mut self, event: StateEvent) -> Result<PubSubState, StateRefused> {
        match self.state.next(event) {
            Ok(state) => {
                self.state = state;
                Ok(state)
            }
            Err(refused) => Err(refused),
        }
    }

    /// Enables the component: to Paused or PreOperational.
    ///
    /// # Errors
    /// [`StateRefused`] when it is enabled.
    pub const fn enable(&mut self) -> Result<PubSubState, StateRefused> {
        self.handle(StateEvent::Enable {
            parent: self.parent,
        })
    }

    /// Disables the component.
    ///
    /// # Errors
    /// [`StateRefused`] when it is disabled.
    pub const fn disable(&mut self) -> Result<PubSubState, StateRefused> {
        self.handle(StateEvent::Disable)
    }

    /// Takes note of the parent's state; the own state that follows.
    pub const fn set_parent(&mut self, parent: PubSubState) -> PubSubState {
        self.parent = parent;
        self.settle(StateEvent::Parent(parent));
        self.state
    }

    /// Takes the event if it has a place in the state; false when it has none.
    pub(crate) const fn settle(&mut self, event: StateEvent) -> bool {
        self.handle(event).is_ok()
    }

    /// The state of the component.
    #[must_use]
    pub const fn state(&self) -> PubSubState {
        self.state
    }

    /// The state the parent was last said to be in.
    #[must_use]
    pub const fn parent(&self) -> PubSubState {
        self.parent
    }
}
