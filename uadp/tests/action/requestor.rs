//! The Requestor: repeats until the first response, acknowledges, and ends every call.

use uadp::OwnedPublisherId;
use uadp::action::{
    ActionDialect, ActionEncoding, ActionFields, ActionOutcome, ActionRequest, ActionState,
    CallRefusal, Refusal, Requestor, RequestorSettings, ResponseDrop, Unknown,
};

use super::STANDARD;
use super::peers::{
    INTERVAL, answer, ask, at, block, message, request, requestor, requests, responder, responses,
};

/// Returns state and TimeoutHint of each request that is due, in milliseconds.
fn due(requestor: &mut Requestor, now: u64) -> Vec<(ActionState, Option<u128>)> {
    requests(requestor, at(now))
        .iter()
        .map(|datagram| {
            message(datagram, STANDARD, |request| {
                let left = request.action.timeout();
                (request.state, left.map(|left| left.as_millis()))
            })
        })
        .collect()
}

const EXECUTING: ActionState = ActionState::Executing;
const IDLE: ActionState = ActionState::Idle;

#[test]
fn a_request_is_repeated_at_the_publishing_interval_until_something_is_heard() {
    let (mut requestor, mut responder) = (requestor(), responder());
    requestor.call(request(&block(1), at(5000)), at(0)).unwrap();
    let first = requests(&mut requestor, at(0));
    assert_eq!(first.len(), 1);
    assert_eq!(requestor.poll_timeout(), Some(INTERVAL));
    assert_eq!(due(&mut requestor, 99), []);
    assert_eq!(
        due(&mut requestor, 100),
        [(EXECUTING, Some(4900))],
        "what is left"
    );
    assert_eq!(due(&mut requestor, 200), [(EXECUTING, Some(4800))]);

    ask(&mut responder, &first[0], at(210)).unwrap();
    let executing = responses(&mut responder, at(210));
    let heard = answer(&mut requestor, &executing[0], at(220));
    assert_eq!(heard, Ok("executing".to_owned()));
    assert_eq!(
        due(&mut requestor, 2000),
        [],
        "not executed twice by a responder that lost it"
    );
    assert_eq!(requestor.poll_timeout(), Some(at(2220)), "receive timeout");
}

#[test]
fn an_answer_is_acknowledged_until_the_responder_is_idle() {
    let (mut requestor, mut responder) = (requestor(), responder());
    requestor.call(request(&block(1), at(5000)), at(0)).unwrap();
    let asked = requests(&mut requestor, at(0));
    let uadp::action::RequiredAction::Execute(execution) =
        ask(&mut responder, &asked[0], at(1)).unwrap()
    else {
        unreachable!("a new request")
    };
    let result = block(42);
    let outcome = ActionOutcome::Answered {
        status: uadp::StatusCode::GOOD,
        fields: ActionFields::Variants(&result),
    };
    responder.finish(execution, outcome, at(2)).unwrap();
    let done = responses(&mut responder, at(2));
    assert_eq!(done.len(), 1, "Done without an Executing before it");
    let heard = answer(&mut requestor, &done[0], at(3)).unwrap();
    assert_eq!(heard, format!("{outcome:?}"));
    assert_eq!(
        answer(&mut requestor, &done[0], at(3)),
        Err(ResponseDrop::Repeated)
    );

    let idle = requests(&mut requestor, at(3));
    assert_eq!(idle.len(), 1);
    assert_eq!(due(&mut requestor, 103), [(IDLE, None)], "again");
    ask(&mut responder, &idle[0], at(104)).unwrap();
    let closed = responses(&mut responder, at(104));
    let heard = answer(&mut requestor, &closed[0], at(105));
    assert_eq!(heard, Ok("closed".to_owned()));
    assert_eq!(
        (requestor.open_calls(), requestor.poll_timeout()),
        (0, None)
    );
    assert_eq!(
        answer(&mut requestor, &done[0], at(106)),
        Err(ResponseDrop::NoCall)
    );
    let counters = requestor.counters();
    assert_eq!(
        (counters.answered, counters.unknown, counters.dropped),
        (1, 0, 2)
    );
}

#[test]
fn unanswered_acknowledgements_come_to_an_end() {
    let mut requestor = requestor();
    let call = requestor.call(request(&block(1), at(150)), at(0)).unwrap();
    assert_eq!(due(&mut requestor, 0).len(), 1);
    assert_eq!(due(&mut requestor, 100).len(), 1);
    let mut idle = 0;
    for tenth in 15..100 {
        for (state, _) in due(&mut requestor, tenth * 10) {
            assert_eq!(state, IDLE);
            idle += 1;
        }
    }
    assert_eq!(idle, 5);
    assert_eq!(requestor.poll_given_up(), Some((call, Unknown::Deadline)));
    assert_eq!(requestor.poll_given_up(), None, "told once");
    assert_eq!(
        (requestor.open_calls(), requestor.poll_timeout()),
        (0, None)
    );
    assert_eq!(requestor.counters().unacknowledged, 1);
}

#[test]
fn a_silent_responder_is_told_within_the_receive_timeout() {
    let (mut requestor, mut responder) = (requestor(), responder());
    let call = requestor
        .call(request(&block(1), at(60_000)), at(0))
        .unwrap();
    let asked = requests(&mut requestor, at(0));
    ask(&mut responder, &asked[0], at(0)).unwrap();
    for now in (0..3000).step_by(100) {
        for datagram in responses(&mut responder, at(now)) {
            answer(&mut requestor, &datagram, at(now)).unwrap();
        }
        requestor.handle_timeout(at(now));
    }
    assert_eq!(requestor.poll_given_up(), None, "it says that it executes");
    requestor.handle_timeout(at(4899));
    assert_eq!(requestor.poll_given_up(), None);
    requestor.handle_timeout(at(4900));
    assert_eq!(requestor.poll_given_up(), Some((call, Unknown::Silent)));
}

#[test]
fn silence_can_be_left_to_the_deadline() {
    let settings = RequestorSettings {
        receive_timeout: std::time::Duration::MAX,
        ..RequestorSettings::default()
    };
    let mut requestor = Requestor::new(OwnedPublisherId::UInt16(1), [7; 16], settings);
    let mut responder = responder();
    let call = requestor
        .call(request(&block(1), at(60_000)), at(0))
        .unwrap();
    let asked = requests(&mut requestor, at(0));
    ask(&mut responder, &asked[0], at(0)).unwrap();
    let executing = responses(&mut responder, at(0));
    answer(&mut requestor, &executing[0], at(0)).unwrap();
    requestor.handle_timeout(at(59_999));
    assert_eq!(
        requestor.poll_given_up(),
        None,
        "said once that it executes"
    );
    requestor.handle_timeout(at(60_000));
    assert_eq!(requestor.poll_given_up(), Some((call, Unknown::Deadline)));
}

#[test]
fn what_is_answered_after_it_was_given_up_is_not_told() {
    let (mut requestor, mut responder) = (requestor(), responder());
    requestor.call(request(&block(1), at(100)), at(0)).unwrap();
    let asked = requests(&mut requestor, at(0));
    let execution = ask(&mut responder, &asked[0], at(0)).unwrap();
    let uadp::action::RequiredAction::Execute(execution) = execution else {
        unreachable!("a new request")
    };
    responder
        .refuse(execution, Refusal::NotAllowed, at(90))
        .unwrap();
    let done = responses(&mut responder, at(90));
    requestor.handle_timeout(at(100));
    assert_eq!(
        answer(&mut requestor, &done[0], at(101)),
        Err(ResponseDrop::Late)
    );
    assert_eq!(requestor.counters().unknown, 1);
}

#[test]
fn answers_to_others_and_from_elsewhere_are_not_taken() {
    let mut responder = responder();
    let mut asking = requestor();
    asking.call(request(&block(1), at(5000)), at(0)).unwrap();
    let asked = requests(&mut asking, at(0));
    assert_eq!(
        answer(&mut asking, &asked[0], at(0)),
        Err(ResponseDrop::Request)
    );
    ask(&mut responder, &asked[0], at(0)).unwrap();
    let [executing] = responses(&mut responder, at(0)).try_into().unwrap();

    let settings = RequestorSettings::default;
    let mut later_life = Requestor::new(OwnedPublisherId::UInt16(1), [8; 16], settings());
    let mut other = Requestor::new(OwnedPublisherId::UInt16(3), [7; 16], settings());
    for requestor in [&mut later_life, &mut other] {
        requestor.call(request(&block(1), at(5000)), at(0)).unwrap();
        assert_eq!(
            answer(requestor, &executing, at(0)),
            Err(ResponseDrop::Foreign)
        );
    }
    let mut elsewhere = executing.clone();
    elsewhere[3] = 9; // PublisherId
    assert_eq!(
        answer(&mut asking, &elsewhere, at(0)),
        Err(ResponseDrop::Elsewhere)
    );
    assert!(answer(&mut asking, &executing, at(0)).is_ok());
}

#[test]
fn a_one_shot_peer_is_asked_once_and_not_acknowledged() {
    let dialect = ActionDialect::UaNetStandard(ActionEncoding::Variant);
    let mut requestor = requestor();
    let arguments = block(1);
    let call = requestor
        .call(
            ActionRequest {
                dialect,
                ..request(&arguments, at(5000))
            },
            at(0),
        )
        .unwrap();
    let asked = requests(&mut requestor, at(0));
    assert_eq!(asked.len(), 1);
    let hint = message(&asked[0], dialect, |request| request.action.timeout());
    assert_eq!(hint, Some(at(5000)));
    for now in (0..5000).step_by(100) {
        assert_eq!(requests(&mut requestor, at(now)).len(), 0);
    }
    requestor.handle_timeout(at(5000));
    assert_eq!(requestor.poll_given_up(), Some((call, Unknown::Deadline)));
    assert_eq!(requestor.open_calls(), 0);
}

#[test]
fn what_cannot_be_asked_for_is_refused_by_reason() {
    let settings = RequestorSettings {
        max_calls: 2,
        max_bytes: 20,
        ..RequestorSettings::default()
    };
    let mut requestor = Requestor::new(OwnedPublisherId::UInt16(1), [7; 16], settings);
    let one = block(1);
    let ask = |fields, dialect| ActionRequest {
        dialect,
        fields,
        ..request(&[], at(1000))
    };
    let one_shot = ActionDialect::UaNetStandard(ActionEncoding::RawData);
    let raw = ActionFields::RawData {
        count: None,
        payload: &[1],
    };
    let variants = ActionFields::Variants(&one);
    let mut refused = |request, why| assert_eq!(requestor.call(request, at(0)), Err(why));
    refused(request(&one, at(0)), CallRefusal::NoTime);
    refused(ask(raw, STANDARD), CallRefusal::Encoding);
    refused(ask(variants, one_shot), CallRefusal::Encoding);
    let long = [&[1, 0, 15, 12, 0, 0, 0][..], &[0; 14]].concat();
    refused(
        request(&long, at(9)),
        CallRefusal::TooManyBytes { bytes: 21 },
    );
    let cut = requestor.call(request(&[9, 0, 0], at(9)), at(0));
    assert!(matches!(cut, Err(CallRefusal::Malformed(_))));

    let first = requestor.call(request(&one, at(9)), at(0)).unwrap();
    requestor.call(request(&one, at(9)), at(0)).unwrap();
    let third = requestor.call(request(&one, at(9)), at(0));
    assert_eq!(third, Err(CallRefusal::TooManyCalls(2)));
    assert!(
        requestor.abandon(first, at(1)),
        "never sent: nothing to acknowledge"
    );
    assert!(!requestor.abandon(first, at(1)));
    requestor.call(request(&one, at(9)), at(1)).unwrap();
}

#[test]
fn request_ids_that_start_over_have_other_correlation_data() {
    let mut requestor = requestor();
    let mut keys = std::collections::BTreeSet::new();
    for _ in 0..=70_000 {
        let call = requestor.call(request(&[0, 0], at(1)), at(0)).unwrap();
        let sent = requestor.poll_transmit(at(0)).unwrap();
        let correlation_data = sent.action.correlation_data.unwrap();
        if sent.request_id < 5 {
            keys.insert((correlation_data.to_vec(), sent.request_id));
        }
        requestor.abandon(call, at(0));
        while requestor.open_calls() > 0 {
            let next = requestor.poll_timeout().unwrap();
            let _ = requestor.poll_transmit(next);
        }
    }
    assert_eq!(keys.len(), 10);
}

#[test]
fn every_refusal_and_unknown_outcome_survives_the_wire() {
    let none = ActionFields::NONE;
    for refusal in Refusal::ALL {
        let (status, fields) = ActionOutcome::Refused(refusal).to_response();
        assert_eq!(fields, none);
        let read = ActionOutcome::of(Some(status.status()), fields);
        assert_eq!(read, ActionOutcome::Refused(refusal));
    }
    for unknown in [Unknown::Deadline, Unknown::Lost] {
        let (status, fields) = ActionOutcome::Unknown(unknown).to_response();
        let read = ActionOutcome::of(Some(status.status()), fields);
        assert_eq!(read, ActionOutcome::Unknown(unknown));
    }
    let good = uadp::StatusCode::GOOD;
    let answered = ActionOutcome::Answered {
        status: good,
        fields: none,
    };
    assert_eq!(ActionOutcome::of(None, none), answered);
    let fields = block(1);
    let executed = ActionOutcome::of(Some(0x80AB), ActionFields::Variants(&fields));
    assert!(
        matches!(executed, ActionOutcome::Answered { .. }),
        "it has fields"
    );
}
