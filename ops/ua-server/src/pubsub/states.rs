//! The states of PubSub components (OPC 10000-14, 6.2.1). Each component has a state, and no
//! component is operational unless its parent is.

/// PubSubState (OPC 10000-14, 6.2.1) by its number.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum PubSubNodeState {
    /// A client has disabled the component.
    Disabled = 0,
    /// The parent is not operational.
    Paused = 1,
    /// The component is operational.
    Operational = 2,
    /// The component is in error.
    Error = 3,
    /// The component waits for its prerequisites.
    PreOperational = 4,
}

/// The cause of a state change.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum StateCause {
    /// A client called Enable or Disable of the component.
    Method,
    /// The state of the parent changed.
    Parent,
    /// The component's own condition changed.
    Itself,
}

/// A changed state.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct StateChange {
    /// The number of the component.
    pub(crate) at: usize,
    pub(crate) was: PubSubNodeState,
    pub(crate) is: PubSubNodeState,
    pub(crate) cause: StateCause,
}

#[derive(Debug)]
struct Component {
    parent: Option<usize>,
    enabled: bool,
    /// True if `enabled` has changed after the last update.
    called: bool,
    /// The component's own condition, which is its state while it is enabled and its parent is
    /// operational.
    own: PubSubNodeState,
    state: PubSubNodeState,
}

/// All components. A parent has a lower number than its children.
#[derive(Debug, Default)]
pub(crate) struct States {
    all: Vec<Component>,
}

impl States {
    /// Adds a component below `parent` and returns its number.
    pub(crate) fn add(&mut self, parent: Option<usize>, own: PubSubNodeState) -> usize {
        let component = Component {
            parent,
            enabled: true,
            called: false,
            own,
            state: own,
        };
        self.all.push(component);
        self.all.len() - 1
    }

    /// Returns the state of a component.
    pub(crate) fn of(&self, at: usize) -> PubSubNodeState {
        let component = self.all.get(at);
        component.map_or(PubSubNodeState::Disabled, |component| component.state)
    }

    /// Sets the own condition of a component.
    pub(crate) fn set_own(&mut self, at: usize, own: PubSubNodeState) {
        if let Some(component) = self.all.get_mut(at) {
            component.own = own;
        }
    }

    /// Enables or disables a component. Returns false if it is in that state already (OPC 10000-14,
    /// 9.1.10).
    pub(crate) fn enable(&mut self, at: usize, enabled: bool) -> bool {
        let Some(component) = self.all.get_mut(at) else {
            return false;
        };
        let other = component.enabled != enabled;
        component.enabled = enabled;
        component.called |= other;
        other
    }

    /// Returns true if a component itself is enabled.
    pub(crate) fn is_enabled(&self, at: usize) -> bool {
        self.all.get(at).is_some_and(|component| component.enabled)
    }

    /// Computes all states and returns the changes.
    pub(crate) fn settle(&mut self) -> Vec<StateChange> {
        let mut changes = Vec::new();
        for at in 0..self.all.len() {
            let Some(component) = self.all.get(at) else {
                continue;
            };
            let above = component.parent.map(|parent| self.of(parent));
            let is = match above {
                _ if !component.enabled => PubSubNodeState::Disabled,
                Some(
                    PubSubNodeState::Disabled | PubSubNodeState::Paused | PubSubNodeState::Error,
                ) => PubSubNodeState::Paused,
                Some(PubSubNodeState::Operational | PubSubNodeState::PreOperational) | None => {
                    component.own
                }
            };
            let was = component.state;
            let called = component.called;
            if let Some(component) = self.all.get_mut(at) {
                component.called = false;
                component.state = is;
            }
            if was != is {
                let cause = match (called, was, is) {
                    (true, _, _) => StateCause::Method,
                    (false, PubSubNodeState::Paused, _) | (false, _, PubSubNodeState::Paused) => {
                        StateCause::Parent
                    }
                    (false, _, _) => StateCause::Itself,
                };
                changes.push(StateChange { at, was, is, cause });
            }
        }
        changes
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_below_one_that_is_disabled_is_paused_and_goes_on_with_it() {
        let mut states = States::default();
        let connection = states.add(None, PubSubNodeState::Operational);
        let group = states.add(Some(connection), PubSubNodeState::Operational);
        let writer = states.add(Some(group), PubSubNodeState::Operational);
        assert_eq!(states.settle(), []);
        assert!(states.enable(connection, false));
        assert!(!states.enable(connection, false), "it is already");
        let changes = states.settle();
        let seen: Vec<_> = changes
            .iter()
            .map(|change| (change.at, change.is, change.cause))
            .collect();
        assert_eq!(
            seen,
            [
                (connection, PubSubNodeState::Disabled, StateCause::Method),
                (group, PubSubNodeState::Paused, StateCause::Parent),
                (writer, PubSubNodeState::Paused, StateCause::Parent),
            ]
        );
        states.enable(connection, true);
        states.settle();
        assert_eq!(states.of(writer), PubSubNodeState::Operational);
    }

    #[test]
    fn one_that_is_disabled_stays_so_whatever_is_above_it() {
        let mut states = States::default();
        let group = states.add(None, PubSubNodeState::Operational);
        let reader = states.add(Some(group), PubSubNodeState::PreOperational);
        states.enable(reader, false);
        states.enable(group, false);
        states.settle();
        states.enable(group, true);
        states.settle();
        assert_eq!(states.of(reader), PubSubNodeState::Disabled);
        states.set_own(reader, PubSubNodeState::Error);
        assert_eq!(states.settle(), [], "what it meets with is no matter");
        states.enable(reader, true);
        let changes = states.settle();
        assert_eq!(changes[0].is, PubSubNodeState::Error);
        states.set_own(reader, PubSubNodeState::Operational);
        assert_eq!(states.settle()[0].cause, StateCause::Itself);
    }
}
