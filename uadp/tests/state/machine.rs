//! The state machine and its parents.

use uadp::PubSubState::{Disabled, Error, Operational, Paused, PreOperational};
use uadp::{
    DataSetWriterState, PubSubState, StateEvent, StateMachine, StateRefused, WriterSettings,
};

use crate::state::ms;

/// OPC 10000-14, 6.2.1, Table 2, row by row.
const TABLE: &[(PubSubState, StateEvent, PubSubState)] = &[
    (Disabled, StateEvent::Enable { parent: Disabled }, Paused),
    (Disabled, StateEvent::Enable { parent: Paused }, Paused),
    (
        Disabled,
        StateEvent::Enable {
            parent: Operational,
        },
        PreOperational,
    ),
    (
        Disabled,
        StateEvent::Enable { parent: Error },
        PreOperational,
    ),
    (
        Disabled,
        StateEvent::Enable {
            parent: PreOperational,
        },
        PreOperational,
    ),
    (Paused, StateEvent::Disable, Disabled),
    (Paused, StateEvent::Parent(Operational), PreOperational),
    (PreOperational, StateEvent::Ready, Operational),
    (PreOperational, StateEvent::Disable, Disabled),
    (PreOperational, StateEvent::Parent(Disabled), Paused),
    (PreOperational, StateEvent::Parent(Paused), Paused),
    (PreOperational, StateEvent::Fail, Error),
    (Operational, StateEvent::Disable, Disabled),
    (Operational, StateEvent::Parent(Disabled), Paused),
    (Operational, StateEvent::Parent(Paused), Paused),
    (Operational, StateEvent::Fail, Error),
    (Error, StateEvent::Disable, Disabled),
    (Error, StateEvent::Parent(Disabled), Paused),
    (Error, StateEvent::Parent(Paused), Paused),
    (Error, StateEvent::Resolve, Operational),
    (Error, StateEvent::Restart, PreOperational),
];

pub(crate) const STATES: [PubSubState; 5] = [Disabled, Paused, Operational, Error, PreOperational];

#[test]
fn every_pair_of_state_and_event_is_as_the_table_has_it() {
    let mut events = vec![
        StateEvent::Disable,
        StateEvent::Ready,
        StateEvent::Fail,
        StateEvent::Resolve,
        StateEvent::Restart,
    ];
    for parent in STATES {
        events.extend([StateEvent::Enable { parent }, StateEvent::Parent(parent)]);
    }
    let mut rows = 0;
    for state in STATES {
        for event in &events {
            let row = TABLE
                .iter()
                .find(|(source, trigger, _)| (*source, trigger) == (state, event));
            rows += usize::from(row.is_some());
            let expected = match (row, event) {
                (Some((_, _, target)), _) => Ok(*target),
                (None, StateEvent::Parent(_)) => Ok(state),
                (None, _) => Err(StateRefused {
                    state,
                    event: *event,
                }),
            };
            assert_eq!(state.next(*event), expected);
        }
    }
    assert_eq!(rows, TABLE.len());
}

#[test]
fn the_states_have_the_values_of_the_enumeration() {
    let values = STATES.map(|state| state as u8);
    assert_eq!(values, [0, 1, 2, 3, 4]);
    for (value, state) in (0..).zip(STATES) {
        assert_eq!(PubSubState::from_value(value), Some(state));
    }
    assert_eq!(PubSubState::from_value(5), None);
}

#[test]
fn disabling_a_connection_pauses_its_writers_and_enabling_it_starts_them_anew() {
    let mut connection = StateMachine::new(Operational);
    let mut group = StateMachine::new(connection.state());
    let mut writer = DataSetWriterState::new(
        WriterSettings::new(ms(100), ms(100), 1).unwrap(),
        group.state(),
    );
    assert_eq!(writer.enable(), Ok(Paused));
    assert_eq!(group.enable(), Ok(Paused));
    let mut change = |connection: &StateMachine| {
        group.set_parent(connection.state());
        if group.state() == PreOperational {
            group.handle(StateEvent::Ready).unwrap();
        }
        writer.set_parent(group.state())
    };
    connection.enable().unwrap();
    assert_eq!(change(&connection), Paused);
    connection.handle(StateEvent::Ready).unwrap();
    assert_eq!(change(&connection), PreOperational);
    connection.handle(StateEvent::Fail).unwrap();
    assert_eq!(change(&connection), PreOperational);
    connection.disable().unwrap();
    assert_eq!(change(&connection), Paused);
    connection.enable().unwrap();
    connection.handle(StateEvent::Ready).unwrap();
    assert_eq!(change(&connection), PreOperational);
}
