use super::*;
use crate::discovery::WireArray;

fn ms(millis: u64) -> Duration {
    Duration::from_millis(millis)
}

fn announcer() -> Announcer {
    Announcer::new([(5, 10), (5, 11), (6, 12)], AnnounceLimits::default())
}

fn due(announcer: &mut Announcer, now: Duration) -> Vec<(AnnouncedSubject, Vec<u16>)> {
    std::iter::from_fn(|| announcer.poll(now))
        .map(|due| (due.subject, due.writer_ids))
        .collect()
}

#[test]
fn actions_are_announced_to_who_asks_for_their_connections_or_metadata() {
    let connections = Probe::PubSubConnections {
        transport_profile_uris: WireArray::new(&[]),
        include_writer_groups: true,
        include_data_set_writers: false,
    };
    let mut announcer = Announcer::new([(5, 10)], AnnounceLimits::default());
    announcer.handle_probe(&connections, Duration::ZERO);
    let only = [(AnnouncedSubject::PubSubConnections, vec![])];
    assert_eq!(due(&mut announcer, Duration::from_secs(1)), only);

    announcer.set_actions([61]);
    let now = Duration::from_secs(2);
    announcer.handle_probe(&connections, now);
    announcer.handle_probe(&Probe::DataSetMetaData(WireArray::new(&[10, 61])), now);
    let mut subjects = due(&mut announcer, now + Duration::from_secs(1));
    subjects.sort();
    let expected = [
        (AnnouncedSubject::PubSubConnections, vec![]),
        (AnnouncedSubject::DataSetMetaData(10), vec![]),
        (AnnouncedSubject::ActionResponder, vec![]),
        (AnnouncedSubject::ActionMetaData(61), vec![]),
    ];
    assert_eq!(subjects, expected);

    let changed = AnnouncedSubject::ActionMetaData(61);
    let now = Duration::from_secs(9);
    let planned = announcer.announce(changed, Included::default(), now);
    assert_eq!(planned, Ok(()), "unasked, after a change");
}

#[test]
fn several_probes_for_one_subject_are_answered_once() {
    let mut announcer = announcer();
    let probe = Probe::DataSetMetaData(WireArray::new(&[10]));
    for millis in [0, 10, 49] {
        announcer.handle_probe(&probe, ms(millis));
    }
    assert_eq!(due(&mut announcer, ms(49)), []);
    assert_eq!(
        due(&mut announcer, ms(50)),
        [(AnnouncedSubject::DataSetMetaData(10), vec![])]
    );
    let counters = AnnounceCounters {
        planned: 1,
        duplicate: 2,
        unknown: 0,
    };
    assert_eq!(*announcer.counters(), counters);
    assert_eq!(announcer.poll_timeout(), None);
}

#[test]
fn the_same_subject_is_announced_again_500_ms_later_at_the_earliest() {
    let mut announcer = announcer();
    announcer.handle_probe(&Probe::PublisherEndpoints, ms(0));
    assert_eq!(due(&mut announcer, ms(50)).len(), 1);
    announcer.handle_probe(&Probe::PublisherEndpoints, ms(60));
    announcer.handle_probe(&Probe::FindApplications, ms(60));
    assert_eq!(
        due(&mut announcer, ms(549)),
        [(AnnouncedSubject::ApplicationInformation, vec![])]
    );
    assert_eq!(announcer.poll_timeout(), Some(ms(550)));
    assert_eq!(
        due(&mut announcer, ms(550)),
        [(AnnouncedSubject::PublisherEndpoints, vec![])]
    );
    announcer.handle_probe(&Probe::PublisherEndpoints, ms(2000));
    assert_eq!(announcer.poll_timeout(), Some(ms(2050)));
}

#[test]
fn data_set_writers_of_one_group_share_an_announcement() {
    let mut announcer = announcer();
    announcer.handle_probe(
        &Probe::DataSetWriterConfiguration(WireArray::new(&[12, 11])),
        ms(0),
    );
    announcer.handle_probe(
        &Probe::DataSetWriterConfiguration(WireArray::new(&[10])),
        ms(40),
    );
    assert_eq!(
        due(&mut announcer, ms(50)),
        [
            (
                AnnouncedSubject::DataSetWriterConfiguration(11),
                vec![10, 11]
            ),
            (AnnouncedSubject::DataSetWriterConfiguration(12), vec![12]),
        ]
    );
    // Writer 10 is included, so it is not due separately.
    assert_eq!(announcer.poll_timeout(), None);
}

#[test]
fn what_was_announced_just_now_does_not_go_along() {
    let mut announcer = announcer();
    announcer.handle_probe(
        &Probe::DataSetWriterConfiguration(WireArray::new(&[10])),
        ms(0),
    );
    assert_eq!(due(&mut announcer, ms(50)).len(), 1);
    announcer.handle_probe(
        &Probe::DataSetWriterConfiguration(WireArray::new(&[10, 11])),
        ms(100),
    );
    assert_eq!(
        due(&mut announcer, ms(150)),
        [(AnnouncedSubject::DataSetWriterConfiguration(11), vec![11])]
    );
    assert_eq!(
        due(&mut announcer, ms(550)),
        [(AnnouncedSubject::DataSetWriterConfiguration(10), vec![10])]
    );
}

#[test]
fn one_announcement_of_connections_has_what_any_who_asked_wants() {
    let mut announcer = announcer();
    for (include_writer_groups, include_data_set_writers) in [(true, false), (false, true)] {
        let probe = Probe::PubSubConnections {
            transport_profile_uris: WireArray::null(),
            include_writer_groups,
            include_data_set_writers,
        };
        announcer.handle_probe(&probe, ms(0));
    }
    let probe = Probe::WriterGroupConfiguration {
        writer_group_id: 5,
        include_data_set_writers: true,
    };
    announcer.handle_probe(&probe, ms(0));
    let first = announcer.poll(ms(50)).unwrap();
    assert_eq!(first.subject, AnnouncedSubject::PubSubConnections);
    // DataSetWriters without their groups cannot be included.
    let groups = Included {
        writer_groups: true,
        data_set_writers: false,
    };
    assert_eq!(first.included, groups);
    let second = announcer.poll(ms(50)).unwrap();
    assert_eq!(
        second.subject,
        AnnouncedSubject::WriterGroupConfiguration(5)
    );
    assert!(second.included.data_set_writers);
}

#[test]
fn a_flood_of_probes_for_unknown_writers_gets_few_answers_and_the_known_one_first() {
    let mut announcer = announcer();
    let ids: Vec<u16> = (10..=60_000).collect();
    for millis in 0..3 {
        announcer.handle_probe(&Probe::DataSetMetaData(WireArray::new(&ids)), ms(millis));
    }
    let answers = due(&mut announcer, ms(50));
    assert_eq!(answers.len(), 3 + 8);
    assert_eq!(answers[2], (AnnouncedSubject::DataSetMetaData(12), vec![]));
    assert_eq!(answers[10], (AnnouncedSubject::DataSetMetaData(20), vec![]));
    assert_eq!(announcer.counters().planned, 11);
    assert_eq!(announcer.counters().duplicate, 2 * 11);
    assert_eq!(announcer.counters().unknown, 3 * (59_991 - 11));
    // After 500 ms other unknown subjects are permitted.
    announcer.handle_probe(
        &Probe::DataSetMetaData(WireArray::new(&ids[100..])),
        ms(550),
    );
    assert_eq!(due(&mut announcer, ms(600)).len(), 8);
}

#[test]
fn announcements_beyond_the_rate_wait() {
    let ids: Vec<u16> = (1..=5).collect();
    let limits = AnnounceLimits {
        rate: 2,
        ..AnnounceLimits::default()
    };
    let mut announcer = Announcer::new(ids.iter().map(|id| (1, *id)), limits);
    announcer.handle_probe(&Probe::DataSetMetaData(WireArray::new(&ids)), ms(0));
    let mut sent = Vec::new();
    while let Some(at) = announcer.poll_timeout() {
        sent.push((at, due(&mut announcer, at).len()));
    }
    assert_eq!(sent, [(ms(50), 2), (ms(550), 2), (ms(1050), 1)]);
}

#[test]
fn no_500_ms_have_more_announcements_than_the_rate() {
    let limits = AnnounceLimits {
        gather: Duration::ZERO,
        rate: 2,
        ..AnnounceLimits::default()
    };
    let mut announcer = Announcer::new([(1, 1)], limits);
    for (subject, at) in [
        (AnnouncedSubject::PublisherEndpoints, 0),
        (AnnouncedSubject::PubSubConnections, 499),
        (AnnouncedSubject::DataSetMetaData(1), 499),
        (AnnouncedSubject::ApplicationInformation, 500),
    ] {
        announcer
            .announce(subject, Included::default(), ms(at))
            .unwrap();
    }
    let mut sent = Vec::new();
    while let Some(at) = announcer.poll_timeout() {
        sent.push((at, due(&mut announcer, at).len()));
    }
    assert_eq!(sent, [(ms(0), 1), (ms(499), 1), (ms(500), 1), (ms(999), 1)]);
}

#[test]
fn sequence_numbers_count_announcements_and_wrap() {
    let mut announcer = announcer();
    let mut now = Duration::ZERO;
    let mut numbers = Vec::new();
    for _ in 0..=65_536 {
        announcer
            .announce(
                AnnouncedSubject::PublisherEndpoints,
                Included::default(),
                now,
            )
            .unwrap();
        now = announcer.poll_timeout().unwrap();
        numbers.push(announcer.poll(now).unwrap().sequence_number);
    }
    assert_eq!(numbers[..2], [0, 1]);
    assert_eq!(numbers[65_534..], [65_534, 65_535, 0]);
}

#[test]
fn a_change_of_the_writers_forgets_what_is_planned() {
    let mut announcer = announcer();
    announcer.handle_probe(&Probe::DataSetMetaData(WireArray::new(&[10, 99])), ms(0));
    announcer.set_writers([(7, 99)]);
    assert_eq!(announcer.poll_timeout(), None);
    announcer.handle_probe(&Probe::DataSetMetaData(WireArray::new(&[10, 99])), ms(0));
    assert_eq!(
        due(&mut announcer, ms(50)),
        [
            (AnnouncedSubject::DataSetMetaData(99), vec![]),
            (AnnouncedSubject::DataSetMetaData(10), vec![]),
        ]
    );
}
