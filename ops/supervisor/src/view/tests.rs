use super::*;
use crate::board::tests::{at, take, topic};
use crate::program::ProgramStatus;

fn data(event: &str) -> Value {
    let data = event.strip_prefix("event: view\ndata: ").unwrap();
    serde_json::from_str(data.trim_end()).unwrap()
}

fn filled(count: u16) -> CellBoard {
    let mut board = CellBoard::default();
    for id in 1..=count {
        take(&mut board, TopicId::new(1, 2, id).unwrap(), id.into(), 0);
    }
    board
}

#[test]
fn the_query_names_the_view() {
    let window = Window {
        from: 20,
        count: 40,
        filter: "arm a".to_owned(),
        only_bad: true,
    };
    let query = "view=values&from=20&count=40&filter=Arm+%41&only=bad";
    assert_eq!(BrowserView::parse(query), Ok(BrowserView::Values(window)));
    assert_eq!(BrowserView::parse("view=skills"), Ok(BrowserView::Skills));
    for wrong in ["", "view=all", "view=values&from=x", "view=topic&topic=x"] {
        assert!(BrowserView::parse(wrong).is_err(), "{wrong}");
    }
}

#[test]
fn only_visible_rows_are_sent_and_only_if_they_have_changed() {
    let mut board = filled(1000);
    let view = BrowserView::parse("view=values&from=100&count=20").unwrap();
    let mut viewer = Viewer::new(view);
    let first = data(&viewer.next(&mut board, at(0).since).unwrap());
    assert_eq!(first["total"], 1000);
    assert_eq!(first["rows"].as_object().unwrap().len(), 20);
    assert_eq!(viewer.next(&mut board, at(250).since), None);
    let shown = first["order"][3].as_str().unwrap();
    take(&mut board, topic(shown), 7.5, 300);
    // Far outside of the window.
    take(&mut board, topic("ua_1_2_9"), 1.0, 300);
    let next = data(&viewer.next(&mut board, at(500).since).unwrap());
    let rows = next["rows"].as_object().unwrap();
    assert_eq!(rows.keys().collect::<Vec<_>>(), [shown]);
    assert_eq!(rows[shown]["value"], "7.5");
    assert!(next.get("order").is_none());
}

#[test]
fn a_browser_that_does_not_read_costs_nothing_and_then_gets_the_last_value() {
    let mut board = filled(1);
    let mut viewer = Viewer::new(BrowserView::parse("view=values&count=10").unwrap());
    viewer.next(&mut board, at(0).since).unwrap();
    for millis in 0..1000 {
        take(&mut board, topic("ua_1_2_1"), 0.5 + f64::from(millis), 1000);
    }
    let next = data(&viewer.next(&mut board, at(2000).since).unwrap());
    assert_eq!(next["rows"]["ua_1_2_1"]["value"], "999.5");
    assert_eq!(viewer.sent.len(), 1);
}

#[test]
fn a_quiet_view_is_kept_alive() {
    let mut board = CellBoard::default();
    let mut viewer = Viewer::new(BrowserView::Map);
    assert!(viewer.next(&mut board, at(0).since).is_some());
    assert_eq!(viewer.next(&mut board, at(1000).since), None);
    let alive = viewer.next(&mut board, at(6000).since).unwrap();
    assert!(alive.starts_with("event: alive"), "{alive}");
}

#[test]
fn each_event_is_sent_once() {
    let mut board = CellBoard::default();
    let mut viewer = Viewer::new(BrowserView::Events);
    let first = data(&viewer.next(&mut board, at(0).since).unwrap());
    assert_eq!(
        (&first["all"], &first["events"]),
        (&json!(true), &json!([]))
    );
    assert_eq!(viewer.next(&mut board, at(250).since), None);
    for number in 1..3_u8 {
        let sample = crate::board::BoardSample {
            topic: topic("ua_1_2_1"),
            block: &vec![1, 0, 3, number].into(),
            source: None,
            status: 0,
        };
        board.take(sample, at(300));
        let next = data(&viewer.next(&mut board, at(500).since).unwrap());
        assert_eq!(next["events"].as_array().unwrap().len(), 1);
        assert_eq!(next["events"][0]["text"], number.to_string());
    }
    assert_eq!(viewer.next(&mut board, at(750).since), None);
    let named = crate::announced::AnnouncedValue {
        name: "Storage.Covers".to_owned(),
        ..crate::announced::AnnouncedValue::default()
    };
    board.describe(topic("ua_1_2_1"), named);
    let renamed = data(&viewer.next(&mut board, at(1000).since).unwrap());
    assert_eq!(renamed["names"]["ua_1_2_1"][0], "Storage");
    assert_eq!(renamed["events"], json!([]));
}

#[test]
fn bad_values_can_be_shown_alone() {
    let mut board = filled(3);
    board.set_silent(topic("ua_1_2_2"), true);
    let mut viewer = Viewer::new(BrowserView::parse("view=values&only=bad").unwrap());
    let shown = data(&viewer.next(&mut board, at(0).since).unwrap());
    assert_eq!(shown["order"], json!(["ua_1_2_2"]));
    assert_eq!(shown["rows"]["ua_1_2_2"]["quality"], "no data");
}

#[test]
fn a_missing_topic_has_reasons() {
    let mut board = CellBoard::default();
    board.set_programs(vec![ProgramStatus {
        source: "this program".to_owned(),
        status: Ok(json!({
            "program": "bridge-ros1", "space": 1, "not_ready": ["no ROS master answers"],
            "waiting_for": ["topic ua_1_2_10: no publisher"],
        })),
    }]);
    let reasons = why(&board, topic("ua_1_2_10"));
    assert_eq!(
        reasons,
        [
            "bridge-ros1 waits for topic ua_1_2_10: no publisher",
            "bridge-ros1 is not ready",
            "no message of this topic was received in the group",
        ]
    );
    take(&mut board, topic("ua_1_2_10"), 1.0, 0);
    assert!(why(&board, topic("ua_1_2_10")).is_empty());
}

#[test]
fn the_map_shows_rates_and_programs_that_are_not_ready() {
    let mut board = filled(2);
    for millis in (1000..7000).step_by(100) {
        take(&mut board, topic("ua_1_2_1"), 1.0, millis);
    }
    board.set_programs(vec![ProgramStatus {
        source: String::new(),
        status: Ok(json!({ "program": "bridge-ros1", "space": 1, "not_ready": ["x"] })),
    }]);
    let shown = map(&mut board, at(7000).since);
    assert_eq!(shown["worlds"]["1"]["hz"], 10.0);
    assert_eq!(
        shown["worlds"]["1"]["problems"][0],
        "bridge-ros1 is not ready"
    );
    assert_eq!(shown["worlds"]["2"]["topics"], 0);
}

#[test]
fn the_knowledge_has_a_mes_once_its_status_was_read() {
    let mut board = CellBoard::default();
    let mut viewer = Viewer::new(BrowserView::parse("view=knowledge").unwrap());
    let mut shown = |board: &mut CellBoard, millis| {
        let event = viewer.next(board, at(millis).since);
        event.map(|event| data(&event)["mes"].clone())
    };
    assert_eq!(shown(&mut board, 0), Some(Value::Null), "not known yet");
    let program = |status| ProgramStatus {
        source: "http://127.0.0.1:8087".to_owned(),
        status: Ok(status),
    };
    board.set_programs(vec![program(json!({ "program": "bridge-ros1" }))]);
    assert_eq!(shown(&mut board, 1000), Some(json!(false)));
    board.set_programs(vec![program(json!({ "processes": [] }))]);
    assert_eq!(shown(&mut board, 2000), Some(json!(true)));
}

#[test]
fn a_topic_has_its_own_hops_where_programs_report_its_steps() {
    let mut board = filled(1);
    let of_all = json!({ "out": { "count": 9, "p50_us": 1.0 } });
    let program = |source: &str, space: u64| ProgramStatus {
        source: source.to_owned(),
        status: Ok(json!({ "program": "bridge", "space": space, "hops": of_all })),
    };
    board.set_programs(vec![program("a", 1), program("b", 2), program("c", 3)]);
    let own = json!({ "out": { "count": 2, "p50_us": 7.5 } });
    let reporting = [
        ("a".to_owned(), [(1, own.clone())].into()),
        ("b".to_owned(), [].into()),
    ];
    board.hops.insert(topic("ua_1_2_1"), reporting.into());
    let view = BrowserView::parse("view=topic&topic=ua_1_2_1").unwrap();
    let mut viewer = Viewer::new(view);
    let shown = data(&viewer.next(&mut board, at(0).since).unwrap());
    let hops = shown["hops"].as_array().unwrap();
    let of = |at: usize| (&hops[at]["hops"], hops[at]["of_topic"].as_bool().unwrap());
    assert_eq!(of(0), (&own, true));
    assert_eq!(of(1), (&json!({}), true));
    assert_eq!(of(2), (&of_all, false));
}
