//! Skills behind two stations: clients two levels up find, run and follow them as if they stood
//! beside them.

mod product;
mod secured;

use std::path::{Path, PathBuf};
use std::time::Duration;

use nix::sys::signal::Signal;
use serde_json::{Value, json};
use skills::{
    ClientOptions, Detector, FoundSkill, ParameterType, RunnableSkill as _, SkillClient, SkillFault,
};
use system_tests::{
    Cell, Child, Peer, PlantSite, Segment, StartedChild, eventually, http_get, metrics, program,
};

use super::{SOON, STATUS};

/// Network prefixes of the levels, from the devices up.
const LEVELS: [&str; 3] = ["10.91.0", "10.92.0", "10.93.0"];
const ROBOT: &str = "urn:ua-bridge:system-tests:robot";
const GRIPPER: &str = "urn:ua-bridge:system-tests:gripper";

/// A device below a station, which is below another station, and a client above both.
struct Tower {
    /// Keep the networks alive.
    _levels: [Segment; 3],
    stations: [PlantSite; 2],
    devices: [PlantSite; 2],
    client: PlantSite,
}

fn tower(cell: &Cell) -> Tower {
    let levels = [0, 1, 2].map(|_| cell.segment());
    let stations = [0, 1].map(|at| {
        let site = cell.site();
        levels[at].plug(&site, "lower0", &format!("{}.1", LEVELS[at]));
        levels[at + 1].plug(&site, "upper0", &format!("{}.11", LEVELS[at + 1]));
        site
    });
    let devices = [21, 22].map(|last| {
        let site = cell.site();
        levels[0].plug(&site, "dev0", &format!("{}.{last}", LEVELS[0]));
        site
    });
    let client = cell.site();
    levels[2].plug(&client, "top0", &format!("{}.50", LEVELS[2]));
    Tower {
        _levels: levels,
        stations,
        devices,
        client,
    }
}

fn station(tower: &Tower, at: usize) -> Child {
    station_started(tower, at).start()
}

fn station_started(tower: &Tower, at: usize) -> StartedChild {
    let name = ["station-low", "station-high"][at];
    StartedChild::new(name, &program("ua-station"))
        .args(["--name", name, "--interface", "lower0"])
        .args(["--endpoint", &format!("opc.tcp://{}.1:4840", LEVELS[at])])
        .args(["--upper-interface", "upper0"])
        .args(["--upper-endpoint", &upper(at)])
        .args(["--upper-lds", "uri=urn:*"])
        .args(["--allow-unsecured", "--metrics", STATUS])
        .at(&tower.stations[at])
}

/// Returns the endpoint of a station on the level above it.
fn upper(at: usize) -> String {
    format!("opc.tcp://{}.11:4841", LEVELS[at + 1])
}

fn robot(cell: &Cell, tower: &Tower) -> Child {
    let yaml = format!(
        "{{component: robot, application_uri: '{ROBOT}', namespace: 6, security: [None], skills: [
            {{name: Ptp, type: PtpMoveSkillType, driver: {{simulated: {{reach: 1.3}}}}}},
            {{name: Linear, type: LinearMoveSkillType, driver: {{simulated: {{reach: 1.3}}}}}}]}}"
    );
    let file = cell.file("robot.yaml", &yaml);
    component(&file, &tower.devices[0], 21)
}

/// Writes the file of a gripper.
fn gripper(cell: &Cell) -> PathBuf {
    let yaml = format!(
        "{{component: gripper, application_uri: '{GRIPPER}', namespace: 7, security: [None], skills: [
            {{name: Grasp, type: GraspSkillType, driver: {{simulated: {{duration: 50 ms}}}}}},
            {{name: Release, type: ReleaseSkillType, driver: {{simulated: {{duration: 50 ms}}}}}}]}}"
    );
    cell.file("gripper.yaml", &yaml)
}

fn component(file: &Path, site: &PlantSite, last: u8) -> Child {
    component_started(file, site, last).start()
}

fn component_started(file: &Path, site: &PlantSite, last: u8) -> StartedChild {
    let endpoint = format!("opc.tcp://{}.{last}:4850", LEVELS[0]);
    StartedChild::new("ua-component", &program("ua-component"))
        .args([file])
        .args([
            "--endpoint",
            &endpoint,
            "--lds",
            "any",
            "--interface",
            "dev0",
        ])
        .at(site)
}

/// Runs a future on the host of the client.
fn on_top<T: Send>(tower: &Tower, what: impl AsyncFnOnce() -> T + Send) -> T {
    tower.client.within(|| {
        let runtime = tokio::runtime::Builder::new_current_thread();
        let runtime = { runtime }.enable_all().build().unwrap();
        runtime.block_on(what())
    })
}

/// Waits for a skill that the client finds at the upper station.
async fn found(client: &SkillClient, of: &str) -> FoundSkill {
    let limit = tokio::time::Instant::now() + SOON;
    loop {
        let mut found = client.skills_of(&ParameterType::own(of)).await.unwrap();
        if let Some(found) = found.pop() {
            return found;
        }
        assert!(tokio::time::Instant::now() < limit, "no {of} is found");
        tokio::time::sleep(Duration::from_millis(50)).await;
    }
}

async fn connected() -> SkillClient {
    let limit = tokio::time::Instant::now() + SOON;
    loop {
        match SkillClient::connect(&upper(1), &ClientOptions::default()).await {
            Ok(client) => return client,
            Err(fault) => assert!(tokio::time::Instant::now() < limit, "{fault}"),
        }
    }
}

fn to(x: f64) -> Vec<(String, skills::SkillValue)> {
    vec![(
        "TargetPosition".to_owned(),
        [x, 0.2, 0.3, 0.0, 0.0, 0.0].into(),
    )]
}

/// A move that takes a minute.
fn slowly(x: f64) -> Vec<(String, skills::SkillValue)> {
    let slow = [("MaxVelocity".to_owned(), 0.01.into())];
    to(x).into_iter().chain(slow).collect()
}

#[test]
#[expect(clippy::too_many_lines, reason = "one story of one component")]
fn a_skill_is_run_and_followed_through_two_stations_until_its_component_is_lost() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let tower = tower(&cell);
    let _stations = [station(&tower, 0), station(&tower, 1)];
    let robot = robot(&cell, &tower);
    let ptp = on_top(&tower, async || {
        let client = connected().await;
        let ptp = found(&client, "PtpMoveSkillType").await;
        client.close().await;
        ptp
    });
    assert_eq!(
        (ptp.component.as_str(), ptp.name.as_str()),
        ("robot", "Ptp")
    );
    assert_eq!(ptp.behind.as_deref(), Some(ROBOT));
    let names: Vec<&str> = ptp.parameters.iter().map(|of| of.name.as_str()).collect();
    assert!(names.contains(&"TargetPosition"), "{names:?}");
    let identifiers: Vec<&str> = ptp.types.iter().map(|of| &*of.identifier).collect();
    assert!(
        identifiers.iter().all(|id| id.starts_with("i=")),
        "the types keep their identity: {identifiers:?}"
    );
    // asyncua follows the skill, on the same host as the client that runs it.
    let (_, identifier) = ptp.node.split_once(';').unwrap();
    let node = format!("ns=1;{identifier}");
    let mut judge = cell
        .asyncua_started("opcua_through.py", &[&upper(1), &node, "--limit", "120"])
        .at(&tower.client)
        .start();
    let types = judge.wait_for_json("its types", SOON, |line| line.get("types").cloned());
    assert_eq!(
        types[0],
        json!(["urn:ua-bridge:skills", "PtpMoveSkillType"]),
        "{types}"
    );
    judge.wait_for_json("its subscription", SOON, |line| line.get("ready").cloned());
    let fault = on_top(&tower, async || {
        let client = connected().await;
        let handle = client.handle(&found(&client, "PtpMoveSkillType").await);
        let outcome = handle.run(to(0.5), SOON).await.unwrap();
        assert!(outcome.succeeded, "{outcome:?}");
        let (_, position) = &outcome.results[0];
        assert!(
            (position.as_f64s().unwrap()[0] - 0.5).abs() < 1e-6,
            "{outcome:?}"
        );
        // The component is killed in the middle of the next run.
        let lost = async {
            while handle.state().await.unwrap().state.name() != "Running" {
                tokio::time::sleep(Duration::from_millis(20)).await;
            }
            robot.signal(Signal::SIGKILL);
        };
        let (ran, ()) = tokio::join!(handle.run(slowly(-0.5), SOON * 2), lost);
        ran.unwrap_err()
    });
    assert!(
        matches!(fault, SkillFault::Lost(_)),
        "the end of the run is unknown: {fault}"
    );
    judge.wait_for_json("the loss", SOON, |line| {
        (line["status"] == "BadNoCommunication" || line["status"] == "BadNodeIdUnknown")
            .then_some(())
    });
    let lines = judge.json_lines();
    let values: Vec<&Value> = lines
        .iter()
        .filter(|line| line["status"] == "Good")
        .map(|line| &line["value"])
        .collect();
    let follow = |wanted: &[&str]| {
        let mut values = values.iter();
        wanted
            .iter()
            .all(|wanted| values.any(|value| *value == wanted))
    };
    assert!(
        follow(&["Halted", "Ready", "Running", "Ready", "Running"]),
        "{values:?}"
    );
    let events: Vec<&Value> = lines
        .iter()
        .filter(|line| line.get("event").is_some())
        .collect();
    let to: Vec<&Value> = events.iter().map(|line| &line["to"]).collect();
    assert_eq!(to, ["Ready", "Running", "Ready", "Running"], "{events:?}");
    let numbers: Vec<&Value> = events.iter().map(|line| &line["number"]).collect();
    assert_eq!(numbers, [12, 13, 12, 13], "{events:?}");
    for event in events {
        assert_eq!(event["source"], "Ptp", "{event}");
        assert_eq!(event["node"], node, "{event}");
        assert_eq!(event["of"], "SkillTransitionEventType", "{event}");
    }
}

#[test]
fn a_detector_follows_components_that_come_and_go_behind_two_stations() {
    let Some(cell) = Cell::with(&[]) else {
        return;
    };
    let tower = tower(&cell);
    let _stations = [station(&tower, 0), station(&tower, 1)];
    let _robot = robot(&cell, &tower);
    let gripper = gripper(&cell);
    let uris = |detector: &Detector| {
        let all = detector.all().into_iter();
        let mut uris: Vec<(String, String)> =
            all.map(|one| (one.application_uri, one.endpoint)).collect();
        uris.sort();
        uris.dedup();
        uris
    };
    let until = async |detector: &Detector, wanted: &[&str]| {
        let limit = tokio::time::Instant::now() + SOON;
        loop {
            let found = uris(detector);
            if found.iter().map(|(uri, _)| uri).eq(wanted) {
                return found;
            }
            assert!(tokio::time::Instant::now() < limit, "{found:?}");
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    };
    on_top(&tower, async || {
        let detector = Detector::new(ClientOptions::default());
        detector.seen("station-high", &upper(1));
        until(&detector, &[ROBOT]).await;
        let gripper = component(&gripper, &tower.devices[1], 22);
        let found = until(&detector, &[GRIPPER, ROBOT]).await;
        // Each component behind the station has an endpoint of its own.
        assert_eq!(found[0].1, format!("{}#{GRIPPER}", upper(1)));
        let of = detector.of_type(&ParameterType::own("GraspSkillType"));
        let (client, handle) = detector.open(&of[0]).await.unwrap();
        let outcome = handle.run(Vec::new(), SOON).await.unwrap();
        assert!(outcome.succeeded, "{outcome:?}");
        let moves = client
            .skills_of(&ParameterType::own("MotionSkillType"))
            .await;
        assert_eq!(moves.unwrap(), [], "another component of the station");
        client.close().await;
        gripper.signal(Signal::SIGKILL);
        until(&detector, &[ROBOT]).await;
    });
}

#[test]
#[expect(clippy::too_many_lines, reason = "one story of two workstations")]
fn a_composite_uses_a_robot_of_another_workstation_and_is_run_from_the_cell() {
    let Some(cell) = Cell::with(&[]) else {
        return;
    };
    let bus = cell.segment();
    let top = cell.site();
    bus.plug(&top, "bus0", "10.94.0.1");
    let below = ["10.95.0", "10.96.0"];
    let workstations = [0, 1].map(|at| {
        let (inside, site, device) = (cell.segment(), cell.site(), cell.site());
        bus.plug(&site, "upper0", &format!("10.94.0.{}", 11 + at));
        inside.plug(&site, "lower0", &format!("{}.1", below[at]));
        inside.plug(&device, "dev0", &format!("{}.21", below[at]));
        (inside, site, device)
    });
    let started = |name: &str, args: &[&str], site: &PlantSite| {
        StartedChild::new(name, &program("ua-station"))
            .args(["--name", name, "--allow-unsecured", "--metrics", STATUS])
            .args(args)
            .at(site)
            .start()
    };
    let top_args = [
        "--interface",
        "bus0",
        "--endpoint",
        "opc.tcp://10.94.0.1:4840",
    ];
    let _top = started("cell", &top_args, &top);
    let _stations = [0, 1].map(|at| {
        let name = ["station-a", "station-b"][at];
        let lower = format!("opc.tcp://{}.1:4840", below[at]);
        let upper = format!("opc.tcp://10.94.0.{}:4841", 11 + at);
        let args = [
            "--interface",
            "lower0",
            "--endpoint",
            &lower,
            "--upper-interface",
            "upper0",
            "--upper-endpoint",
            &upper,
            "--upper-lds",
            "uri=urn:*",
        ];
        started(name, &args, &workstations[at].1)
    });
    let serve = |name: &str, at: usize, port: u16, yaml: &str| {
        let endpoint = format!("opc.tcp://{}.21:{port}", below[at]);
        StartedChild::new(name, &program("ua-component"))
            .args([cell.file(&format!("{name}.yaml"), yaml)])
            .args([
                "--endpoint",
                &endpoint,
                "--lds",
                "any",
                "--interface",
                "dev0",
            ])
            .at(&workstations[at].2)
            .start()
    };
    let _robot = serve("robot", 0, 4850, &format!(
        "{{component: robot, application_uri: '{ROBOT}', namespace: 6, security: [None], skills: [
            {{name: Ptp, type: PtpMoveSkillType, driver: {{simulated: {{reach: 1.3, time_scale: 20}}}}}},
            {{name: Linear, type: LinearMoveSkillType, driver: {{simulated: {{reach: 1.3, time_scale: 20}}}}}}]}}"
    ));
    let _gripper = serve("gripper", 1, 4850, &format!(
        "{{component: gripper, application_uri: '{GRIPPER}', namespace: 7, security: [None], skills: [
            {{name: Grasp, type: GraspSkillType, driver: {{simulated: {{duration: 50 ms}}}}}},
            {{name: Release, type: ReleaseSkillType, driver: {{simulated: {{duration: 50 ms}}}}}}]}}"
    ));
    let _handling = serve("handling", 1, 4851, &format!(
        "{{component: handling, application_uri: 'urn:ua-bridge:system-tests:handling', namespace: 8,
           security: [None], skills: [{{name: Place, type: PickAndPlaceSkillType,
           driver: {{pick_and_place: {{robot: '{ROBOT}', gripper: '{GRIPPER}', within: 60 s}}}}}}]}}"
    ));
    eventually("station b sees the robot", SOON, || {
        let status = workstations[1].1.within(|| metrics(STATUS))?;
        let above = status["level"]["above"].as_array()?.clone();
        let mut variables = above.iter().map(|one| one["server"]["variables"].as_u64());
        variables.any(|count| count > Some(50)).then_some(())
    });
    let outcome = top.within(|| {
        let runtime = tokio::runtime::Builder::new_current_thread()
            .enable_all()
            .build()
            .unwrap();
        runtime.block_on(async {
            let station = "opc.tcp://10.94.0.12:4841";
            let client = SkillClient::connect(station, &ClientOptions::default())
                .await
                .unwrap();
            let place = found(&client, "PickAndPlaceSkillType").await;
            assert_eq!(place.component, "handling");
            let handle = client.handle(&place);
            let six = |y: f64| skills::SkillValue::from([0.4, y, 0.1, 0.0, 0.0, 0.0]);
            let given = vec![
                ("PickPosition".to_owned(), six(0.2)),
                ("PlacePosition".to_owned(), six(-0.2)),
            ];
            let outcome = handle.run(given, SOON * 2).await.unwrap();
            client.close().await;
            outcome
        })
    });
    assert!(outcome.succeeded, "{outcome:?}");
    let trace = outcome.trace.join("\n");
    // The robot stands beyond both stations; the gripper beside the composite.
    assert!(trace.contains(&format!("#{ROBOT}: named")), "{trace}");
    assert!(trace.contains("MovePickApproachBefore"), "{trace}");
}

#[test]
fn a_mes_runs_a_process_with_components_behind_two_stations() {
    const PROCESS: &str = "urn:ua-bridge:system-tests:fetch";
    let Some(cell) = Cell::with(&[]) else {
        return;
    };
    let tower = tower(&cell);
    let _stations = [station(&tower, 0), station(&tower, 1)];
    let _robot = robot(&cell, &tower);
    let _gripper = component(&gripper(&cell), &tower.devices[1], 22);
    let yaml = format!(
        "mes: mes
application_uri: urn:ua-bridge:system-tests:mes
namespace: 50
endpoint: opc.tcp://{top}.50:0
security: [None]
processes:
  - process: {PROCESS}
    within: 60 s
    wait: 60 s
    steps:
      - step: over
        needs: {{skill: {{type: PtpMoveSkillType}}}}
        parameters: {{TargetPosition: [0.4, 0.1, 0.4, 0, 0, 0]}}
      - {{step: grip, needs: {{skill: {{type: GraspSkillType}}}}}}
      - step: away
        needs: {{skill: {{type: LinearMoveSkillType}}}}
        parameters: {{TargetPosition: [0.4, 0.1, 0.45, 0, 0, 0]}}
        by: {{component_of: over}}
      - {{step: let go, needs: {{skill: {{type: ReleaseSkillType}}}}}}
",
        top = LEVELS[2]
    );
    let _mes = StartedChild::new("ua-mes", &program("ua-mes"))
        .args([cell.file("mes.yaml", &yaml)])
        .args(["--interface", "top0", "--lds", "none", "--run", PROCESS])
        .at(&tower.client)
        .start();
    let done = eventually("the process has ended", SOON * 3, || {
        let page = tower
            .client
            .within(|| http_get("127.0.0.1:8087", "/status"))?;
        let page: Value = serde_json::from_str(&page).ok()?;
        let run = page["runs"][0].clone();
        matches!(run["outcome"].as_str(), Some("done" | "failed" | "unknown")).then_some(run)
    });
    assert_eq!(done["outcome"], "done", "{done}");
    let ran = done["plans"][0]["ran"].as_array().unwrap();
    let ran: Vec<(&Value, &Value)> = ran
        .iter()
        .map(|of| (&of["step"], &of["component"]))
        .collect();
    let (robot, gripper) = (json!(ROBOT), json!(GRIPPER));
    let steps = ["over", "grip", "away", "let go"].map(|step| json!(step));
    let by = [&robot, &gripper, &robot, &gripper];
    let expected: Vec<(&Value, &Value)> = steps.iter().zip(by).collect();
    assert_eq!(ran, expected, "{done}");
}
