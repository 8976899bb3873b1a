//! The Responder: executes once, remembers, and keeps its limits.

use std::time::Duration;

use uadp::action::{
    ActionDialect, ActionEncoding, ActionFields, ActionOutcome, ActionRequest, ActionState,
    ExecutionId, FinishRefusal, Refusal, RequestDrop, RequestOrigin, Requestor, RequestorSettings,
    RequiredAction, Responder, ResponderSettings,
};
use uadp::{OwnedPublisherId, StatusCode};

use super::STANDARD;
use super::peers::{
    ask, ask_from, at, block, message, number, request, requestor, requests, responder, responses,
};

/// Returns a request as bytes.
fn asked(arguments: i32) -> Vec<u8> {
    let mut requestor = requestor();
    let arguments = block(arguments);
    requestor
        .call(request(&arguments, at(5000)), at(0))
        .unwrap();
    requests(&mut requestor, at(0)).remove(0)
}

/// Changes a request to ActionState Idle. The state precedes the fields.
fn idle(asked: &[u8]) -> Vec<u8> {
    let mut idle = asked.to_vec();
    let state = idle.len() - block(0).len() - 1;
    assert_eq!(idle[state], 1);
    idle[state] = 0;
    idle
}

fn execute(requested: Result<RequiredAction, RequestDrop>) -> ExecutionId {
    match requested {
        Ok(RequiredAction::Execute(execution)) => execution,
        other => unreachable!("{other:?}"),
    }
}

/// Returns the states of the responses that are due.
fn due(responder: &mut Responder<u16>, now: u64) -> Vec<ActionState> {
    responses(responder, at(now))
        .iter()
        .map(|datagram| message(datagram, STANDARD, |response| response.state))
        .collect()
}

fn answered(fields: &[u8]) -> ActionOutcome<'_> {
    ActionOutcome::Answered {
        status: StatusCode::GOOD,
        fields: ActionFields::Variants(fields),
    }
}

const EXECUTING: ActionState = ActionState::Executing;
const DONE: ActionState = ActionState::Done;
const IDLE: ActionState = ActionState::Idle;

#[test]
fn a_repetition_is_not_executed_but_answered_from_memory() {
    let mut responder = responder();
    let asked = asked(1);
    let execution = execute(ask(&mut responder, &asked, at(0)));
    assert_eq!(due(&mut responder, 0), [EXECUTING]);
    let again = ask(&mut responder, &asked, at(10));
    assert_eq!(again, Ok(RequiredAction::Repeated(execution)));
    assert_eq!(due(&mut responder, 10), [], "at most once an interval");
    assert_eq!(due(&mut responder, 100), [EXECUTING]);

    responder
        .finish(execution, answered(&block(42)), at(110))
        .unwrap();
    assert_eq!(due(&mut responder, 110), [DONE], "at once");
    ask(&mut responder, &asked, at(5000)).unwrap();
    let last = responses(&mut responder, at(5000)).remove(0);
    message(&last, STANDARD, |response| {
        assert_eq!(number(response.fields), 42);
        assert_eq!(response.header().status, Some(0));
        assert_eq!(response.request_id, 0);
        assert_eq!(response.action.correlation_data.unwrap()[..16], [7; 16]);
        assert_eq!(
            response.action.requestor_id,
            Some(uadp::PublisherId::UInt16(1))
        );
    });
    assert_eq!(responder.counters().executed, 1);
}

#[test]
fn an_answer_is_said_until_it_is_acknowledged() {
    let mut responder = responder();
    let asked = asked(1);
    let execution = execute(ask(&mut responder, &asked, at(0)));
    responder
        .finish(execution, answered(&block(42)), at(0))
        .unwrap();
    for now in [0, 100, 200] {
        assert_eq!(due(&mut responder, now), [DONE]);
    }
    let closed = ask(&mut responder, &idle(&asked), at(250));
    assert_eq!(closed, Ok(RequiredAction::Closed(execution)));
    assert_eq!(due(&mut responder, 250), [IDLE]);
    assert_eq!(due(&mut responder, 5000), []);
    let late = ask(&mut responder, &asked, at(5000));
    assert_eq!(
        late,
        Ok(RequiredAction::Repeated(execution)),
        "not executed again"
    );
    assert_eq!(due(&mut responder, 5000), []);
}

#[test]
fn an_answer_nobody_acknowledges_is_not_said_for_ever() {
    let mut responder = responder();
    let execution = execute(ask(&mut responder, &asked(1), at(0)));
    responder
        .finish(execution, answered(&block(42)), at(0))
        .unwrap();
    let mut said = 0;
    for now in (0..20_000).step_by(50) {
        said += due(&mut responder, now).len();
    }
    assert_eq!(said, 21, "once, and 20 repetitions");
    assert_eq!((responder.held(), responder.poll_timeout()), ((0, 0), None));
}

#[test]
fn a_request_is_forgotten_when_it_is_old() {
    let mut responder = responder();
    let asked = asked(1);
    let execution = execute(ask(&mut responder, &asked, at(0)));
    responder
        .finish(execution, answered(&block(42)), at(0))
        .unwrap();
    ask(&mut responder, &idle(&asked), at(10)).unwrap();
    assert_eq!(due(&mut responder, 10), [IDLE]);
    assert_eq!(responder.poll_timeout(), Some(at(10_010)));
    responder.handle_timeout(at(10_009));
    assert_eq!(responder.held().0, 1);
    responder.handle_timeout(at(10_010));
    assert_eq!(responder.held(), (0, 0));
}

#[test]
fn what_is_executed_past_its_deadline_is_told_once_and_freed_by_age() {
    let mut responder = responder();
    let asked = asked(1); // timeout of 5 s
    let execution = execute(ask(&mut responder, &asked, at(0)));
    for now in (0..5000).step_by(100) {
        assert_eq!(due(&mut responder, now), [EXECUTING]);
    }
    assert_eq!(responder.poll_overdue(), None);
    assert_eq!(due(&mut responder, 5000), []);
    assert_eq!(responder.poll_overdue(), Some(execution));
    assert_eq!(responder.poll_overdue(), None);
    responder.handle_timeout(at(15_000));
    assert_eq!((responder.held(), responder.counters().lost), ((0, 0), 1));
    let late = responder.finish(execution, answered(&block(42)), at(15_001));
    assert_eq!(late, Err(FinishRefusal::Forgotten));
}

#[test]
fn an_execution_the_requestor_gives_up_is_told_and_its_end_is_not() {
    let mut responder = responder();
    let asked = asked(1);
    let execution = execute(ask(&mut responder, &asked, at(0)));
    assert_eq!(due(&mut responder, 0), [EXECUTING]);
    let abandoned = ask(&mut responder, &idle(&asked), at(150));
    assert_eq!(abandoned, Ok(RequiredAction::Abandoned(execution)));
    assert_eq!(
        due(&mut responder, 150),
        [EXECUTING],
        "which is what it does"
    );
    assert_eq!(due(&mut responder, 1000), []);
    let ended = responder.finish(execution, answered(&block(42)), at(1000));
    assert_eq!(ended, Err(FinishRefusal::Abandoned));
    assert_eq!(due(&mut responder, 1000), []);
    let again = ask(&mut responder, &asked, at(1001));
    assert_eq!(again, Ok(RequiredAction::Repeated(execution)));
}

#[test]
fn a_request_taken_back_before_it_came_is_not_executed() {
    let mut responder = responder();
    let asked = asked(1);
    let closed = ask(&mut responder, &idle(&asked), at(0));
    assert!(matches!(closed, Ok(RequiredAction::Closed(_))));
    assert_eq!(due(&mut responder, 0), [IDLE]);
    let late = ask(&mut responder, &asked, at(10));
    assert!(matches!(late, Ok(RequiredAction::Repeated(_))));
}

#[test]
fn a_refusal_is_remembered() {
    let mut responder = responder();
    let asked = asked(1);
    let execution = execute(ask(&mut responder, &asked, at(0)));
    responder
        .refuse(execution, Refusal::NotAllowed, at(0))
        .unwrap();
    let twice = responder.refuse(execution, Refusal::NotAllowed, at(0));
    assert_eq!(twice, Err(FinishRefusal::Finished));
    let said = responses(&mut responder, at(0)).remove(0);
    let status = message(&said, STANDARD, |response| response.header().status);
    assert_eq!(status, Some(0x801F), "Bad_UserAccessDenied");
    let again = ask(&mut responder, &asked, at(500));
    assert_eq!(again, Ok(RequiredAction::Repeated(execution)));
}

#[test]
fn the_ids_of_one_request_do_not_get_the_answer_of_another() {
    let mut responder = responder();
    execute(ask(&mut responder, &asked(1), at(0)));
    assert_eq!(
        ask(&mut responder, &asked(2), at(0)),
        Err(RequestDrop::Reused)
    );
    let mut elsewhere = asked(1);
    let target = elsewhere.len() - block(0).len() - 5;
    elsewhere[target] = 9;
    assert_eq!(
        ask(&mut responder, &elsewhere, at(0)),
        Err(RequestDrop::Reused)
    );
}

#[test]
fn what_a_requestor_cannot_want_is_dropped() {
    let mut responder = responder();
    let asked = asked(1);
    let state = asked.len() - block(0).len() - 1;
    let mut done = asked.clone();
    done[state] = 2;
    assert_eq!(ask(&mut responder, &done, at(0)), Err(RequestDrop::State));
    ask(&mut responder, &asked, at(0)).unwrap();
    let response = responses(&mut responder, at(0)).remove(0);
    assert_eq!(
        ask(&mut responder, &response, at(0)),
        Err(RequestDrop::Response)
    );
    assert_eq!(responder.counters().dropped, 2);
}

/// Returns requests of a Requestor as bytes.
fn many(requestor_id: u16, count: i32) -> Vec<Vec<u8>> {
    let mut requestor = Requestor::new(
        OwnedPublisherId::UInt16(requestor_id),
        [7; 16],
        RequestorSettings::default(),
    );
    for number in 0..count {
        requestor
            .call(request(&block(number), at(5000)), at(0))
            .unwrap();
    }
    requests(&mut requestor, at(0))
}

#[test]
fn requests_beyond_the_memory_are_dropped_by_reason_and_not_answered() {
    let mut responder = Responder::new(ResponderSettings {
        max_requests: 5,
        max_requests_per_sender: 3,
        ..ResponderSettings::default()
    });
    let (one, two) = (many(1, 4), many(2, 3));
    for asked in &one[..3] {
        execute(ask_from(&mut responder, 0, asked, at(0)));
    }
    assert_eq!(
        ask(&mut responder, &one[3], at(0)),
        Err(RequestDrop::SenderFull)
    );
    for asked in &two[..2] {
        execute(ask_from(&mut responder, 1, asked, at(0)));
    }
    assert_eq!(
        ask_from(&mut responder, 1, &two[2], at(0)),
        Err(RequestDrop::Full)
    );
    assert_eq!(due(&mut responder, 0).len(), 5);
    // The request is accepted when there is space again.
    responder.handle_timeout(at(20_000));
    execute(ask(&mut responder, &two[2], at(20_000)));
}

#[test]
fn requests_that_are_over_make_room_for_others_and_are_still_known() {
    let mut responder = Responder::new(ResponderSettings {
        max_requests: 4,
        max_requests_per_sender: 2,
        max_over: 10,
        max_over_per_sender: 8,
        ..ResponderSettings::default()
    });
    let (one, two) = (many(1, 11), many(2, 3));
    let play = |responder: &mut Responder<u16>, sender: u16, asked: &[u8]| {
        let execution = execute(ask_from(responder, sender, asked, at(0)));
        let told = responder.finish(execution, answered(&block(1)), at(0));
        told.unwrap();
        let closed = ask(responder, &idle(asked), at(0));
        assert_eq!(closed, Ok(RequiredAction::Closed(execution)));
    };
    // Two complete requests and 8 hashes.
    for asked in &one[..10] {
        play(&mut responder, 0, asked);
    }
    let full = ask(&mut responder, &one[10], at(0));
    assert_eq!(full, Err(RequestDrop::SenderFull));
    for asked in &two {
        play(&mut responder, 1, asked);
    }
    assert_eq!(responder.held().0, 13);
    for asked in one[..10].iter().chain(&two) {
        for late in [asked.clone(), idle(asked)] {
            let heard = ask(&mut responder, &late, at(9_000));
            let known = matches!(
                heard,
                Ok(RequiredAction::Repeated(_)) | Err(RequestDrop::Over)
            );
            assert!(known, "{heard:?}");
        }
    }
    while responder.poll_transmit(at(9_000)).is_some() {}
    // The completely remembered requests received a message at 9 s.
    responder.handle_timeout(at(10_000));
    assert_eq!(responder.held().0, 4);
    execute(ask(&mut responder, &one[10], at(10_000)));
    responder.handle_timeout(at(80_000));
    assert_eq!(responder.held(), (0, 0));
}

#[test]
fn a_requestor_that_takes_all_answers_can_ask_thousands_of_times_a_second() {
    let mut responder = responder();
    let mut requestor = Requestor::new(
        OwnedPublisherId::UInt16(1),
        [7; 16],
        RequestorSettings::default(),
    );
    let mut first = None;
    for number in 0..20_000 {
        let arguments = block(number);
        let now = at(u64::from(number.unsigned_abs()) / 20);
        requestor.call(request(&arguments, at(5000)), now).unwrap();
        for asked in requests(&mut requestor, now) {
            let execution = execute(ask(&mut responder, &asked, now));
            responder
                .finish(execution, answered(&arguments), now)
                .unwrap();
            first.get_or_insert(asked);
        }
        exchange(&mut requestor, &mut responder, now);
    }
    assert_eq!(requestor.counters().answered, 20_000);
    let (held, bytes) = responder.held();
    assert_eq!(held, 20_000);
    assert!(bytes < 4 << 20, "{bytes}");
    let late = ask(&mut responder, &first.unwrap(), at(2_000));
    assert_eq!(late, Err(RequestDrop::Over));
}

/// Exchanges messages until no message is due on either side.
fn exchange(requestor: &mut Requestor, responder: &mut Responder<u16>, now: Duration) {
    loop {
        let said = responses(responder, now);
        for datagram in &said {
            message(datagram, STANDARD, |response| {
                let _told = requestor.handle_response(response, now);
            });
        }
        let asked = requests(requestor, now);
        for datagram in &asked {
            let _heard = ask(responder, datagram, now);
        }
        if said.is_empty() && asked.is_empty() {
            return;
        }
    }
}

#[test]
fn requests_beyond_what_can_be_executed_are_refused_as_busy() {
    let mut responder = Responder::new(ResponderSettings {
        max_executing: 1,
        ..ResponderSettings::default()
    });
    let asked = many(1, 3);
    let first = execute(ask(&mut responder, &asked[0], at(0)));
    let second = ask(&mut responder, &asked[1], at(0));
    assert!(matches!(
        second,
        Ok(RequiredAction::Refused(_, Refusal::Busy))
    ));
    responder.finish(first, answered(&block(1)), at(0)).unwrap();
    execute(ask(&mut responder, &asked[2], at(0)));
    let again = ask(&mut responder, &asked[1], at(0));
    assert!(
        matches!(again, Ok(RequiredAction::Repeated(_))),
        "once refused, for good"
    );
}

#[test]
fn bytes_are_bounded_for_each_sender_and_in_all() {
    let mut responder = Responder::new(ResponderSettings {
        max_bytes: 3000,
        max_bytes_per_sender: 2000,
        max_answer: 1500,
        ..ResponderSettings::default()
    });
    let (one, two) = (many(1, 3), many(2, 2));
    let big = |bytes: usize| [&[1, 0][..], &vec![0; bytes]].concat();
    let first = execute(ask(&mut responder, &one[0], at(0)));
    let second = execute(ask(&mut responder, &one[1], at(0)));
    let too_big = responder.finish(first, answered(&big(1600)), at(0));
    assert_eq!(too_big, Err(FinishRefusal::TooBig), "max_answer");
    let said = responses(&mut responder, at(0));
    let status = message(&said[0], STANDARD, |response| response.header().status);
    assert_eq!(status, Some(0x80B9), "Bad_ResponseTooLarge");
    responder
        .finish(second, answered(&big(900)), at(0))
        .unwrap();
    assert_eq!(
        ask(&mut responder, &one[2], at(0)),
        Err(RequestDrop::SenderFull)
    );
    let third = execute(ask_from(&mut responder, 1, &two[0], at(0)));
    let too_big = responder.finish(third, answered(&big(1000)), at(0));
    assert_eq!(too_big, Err(FinishRefusal::TooBig), "max_bytes");
    assert!(responder.held().1 <= 3000);
    responder.handle_timeout(at(60_000));
    while responder.poll_transmit(at(60_000)).is_some() {}
    assert_eq!(responder.held(), (0, 0));
}

/// Passes a request of a group, with the verdict of the owner.
fn ask_judged(
    responder: &mut Responder<u16>,
    (group, sender): (usize, u16),
    datagram: &[u8],
    (verdict, now): (Result<(), Refusal>, u64),
) -> Result<RequiredAction, RequestDrop> {
    let origin = RequestOrigin { group, sender };
    message(datagram, STANDARD, |request| {
        responder.handle_judged(request, (origin, verdict), at(now))
    })
}

#[test]
fn a_refused_request_is_answered_once_and_its_repetitions_a_few_times() {
    let mut responder = responder();
    let asked = asked(1);
    let refused = Err(Refusal::NotAllowed);
    let declined = ask_judged(&mut responder, (0, 0), &asked, (refused, 0));
    assert_eq!(declined, Ok(RequiredAction::Declined(Refusal::NotAllowed)));
    let said = responses(&mut responder, at(0));
    let status = message(&said[0], STANDARD, |response| response.header().status);
    assert_eq!((said.len(), status), (1, Some(0x801F)));
    assert_eq!(responder.poll_timeout(), None, "nothing is left to be said");
    // A repetition within the publishing interval gets no response, and is never executed.
    let mut answers = 0;
    for now in (50..9_000).step_by(50) {
        let again = ask_judged(&mut responder, (0, 0), &asked, (Ok(()), now));
        assert_eq!(again, Err(RequestDrop::Refused));
        answers += due(&mut responder, now).len();
    }
    assert_eq!(answers, 3, "refusal_repeats");
    assert_eq!(responder.held().0, 1);
    responder.handle_timeout(at(10_000));
    assert_eq!(responder.held(), (0, 0));
}

#[test]
fn an_acknowledged_refusal_is_closed_at_once() {
    let mut responder = responder();
    let asked = asked(1);
    let refused = Err(Refusal::NotAllowed);
    ask_judged(&mut responder, (0, 0), &asked, (refused, 0)).unwrap();
    assert_eq!(due(&mut responder, 0), [DONE]);
    let closed = ask_judged(&mut responder, (0, 0), &idle(&asked), (refused, 1));
    assert_eq!(closed, Err(RequestDrop::Refused));
    assert_eq!(due(&mut responder, 1), [IDLE]);
}

#[test]
fn refused_requests_fill_the_room_of_their_sender_and_group_alone() {
    let mut responder = Responder::new(ResponderSettings {
        max_refused: 5,
        max_refused_per_sender: 3,
        max_requests: 2,
        max_executing: 1,
        ..ResponderSettings::default()
    });
    let asked = many(1, 12);
    let refused = Err(Refusal::NotAllowed);
    let mut ask_of =
        |of, number: usize, verdict| ask_judged(&mut responder, of, &asked[number], (verdict, 0));
    for number in 0..3 {
        ask_of((0, 1), number, refused).unwrap();
    }
    assert_eq!(ask_of((0, 1), 3, refused), Err(RequestDrop::SenderFull));
    ask_of((0, 2), 4, refused).unwrap();
    ask_of((0, 2), 5, refused).unwrap();
    assert_eq!(ask_of((0, 2), 6, refused), Err(RequestDrop::Full));
    // Refusals use no space of requests, and each group has its own space.
    execute(ask_of((0, 3), 7, Ok(())));
    let busy = ask_of((0, 4), 8, Ok(()));
    assert!(matches!(
        busy,
        Ok(RequiredAction::Refused(_, Refusal::Busy))
    ));
    assert_eq!(ask_of((0, 5), 9, Ok(())), Err(RequestDrop::Full));
    execute(ask_of((1, 1), 10, Ok(())));
    ask_of((1, 1), 11, refused).unwrap();
    assert_eq!(due(&mut responder, 0).len(), 9, "one answer each");
}

#[test]
fn a_refusal_before_anything_was_said_is_said_again_for_repetitions_alone() {
    let mut responder = responder();
    let asked = many(1, 2);
    let early = execute(ask(&mut responder, &asked[0], at(0)));
    responder.refuse(early, Refusal::Busy, at(0)).unwrap();
    assert_eq!(due(&mut responder, 0), [DONE]);
    assert_eq!(due(&mut responder, 1_000), []);
    ask(&mut responder, &asked[0], at(1_000)).unwrap();
    assert_eq!(due(&mut responder, 1_000), [DONE]);
    // A Requestor that knows of the execution does not repeat its request.
    let late = execute(ask(&mut responder, &asked[1], at(2_000)));
    assert_eq!(due(&mut responder, 2_000), [EXECUTING]);
    responder.refuse(late, Refusal::Busy, at(2_010)).unwrap();
    assert_eq!(due(&mut responder, 2_010), [DONE]);
    assert_eq!(due(&mut responder, 2_110), [DONE]);
}

#[test]
fn long_correlation_data_are_refused() {
    let mut responder = Responder::new(ResponderSettings {
        max_correlation_data: 19,
        ..ResponderSettings::default()
    });
    let refused = ask(&mut responder, &asked(1), at(0));
    assert_eq!(refused, Err(RequestDrop::CorrelationData(20)));
}

#[test]
fn a_one_shot_requestor_is_answered_once_and_never_without_its_status() {
    let dialect = ActionDialect::UaNetStandard(ActionEncoding::Variant);
    let mut responder = responder();
    let mut requestor = requestor();
    let arguments = block(1);
    for _ in 0..2 {
        let request = ActionRequest {
            dialect,
            ..request(&arguments, at(5000))
        };
        requestor.call(request, at(0)).unwrap();
    }
    let asked = requests(&mut requestor, at(0));
    let mut hear = |asked: &[u8], now: Duration| {
        message(asked, dialect, |request| {
            execute(responder.handle_request(request, 3, now))
        })
    };
    let (good, bad) = (hear(&asked[0], at(0)), hear(&asked[1], at(0)));
    assert!(responder.poll_transmit(at(0)).is_none(), "no Executing");
    responder.finish(good, answered(&block(42)), at(1)).unwrap();
    let (reply_to, response) = responder.poll_transmit(at(1)).unwrap();
    assert_eq!(
        (*reply_to, response.state, response.status),
        (3, DONE, None)
    );
    assert_eq!(response.dialect, dialect);
    let untold = responder.refuse(bad, Refusal::NotAllowed, at(1));
    assert_eq!(untold, Err(FinishRefusal::NoStatus));
    for now in (0..9000).step_by(100) {
        assert!(responder.poll_transmit(at(now)).is_none());
    }
    let again = message(&asked[1], dialect, |request| {
        responder.handle_request(request, 3, at(9000))
    });
    assert_eq!(again, Ok(RequiredAction::Repeated(bad)));
    assert!(responder.poll_transmit(at(9000)).is_none());
}
