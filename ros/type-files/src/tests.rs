use std::collections::BTreeMap;

use mappings::{OpenTypeFiles as _, PathFaultKind};
use messages::{Library, TypeRegistry};

use super::*;

/// A temporary folder that is removed on drop.
struct Folder(PathBuf);

impl Folder {
    fn new(name: &str, files: &[(&str, &str)]) -> Self {
        let root = std::env::temp_dir().join(format!("type-files-{name}-{}", std::process::id()));
        for (file, text) in files {
            let path = root.join(file);
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            std::fs::write(path, text).unwrap();
        }
        Self(root)
    }

    fn path(&self, name: &str) -> PathBuf {
        self.0.join(name)
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        std::fs::remove_dir_all(&self.0).unwrap();
    }
}

fn open(paths: &[PathBuf], environment: RosEnvironment) -> TypeFiles {
    TypeFiles::new(Arc::new(TypePaths::read(paths, &mut |_| {})), environment)
}

fn name(text: &str) -> TypeName {
    text.parse().unwrap()
}

fn file(files: &mut TypeFiles, dialect: Dialect, kind: TextKind, wanted: &str) -> Option<String> {
    let found = files.find(dialect, kind, &name(wanted))?;
    Some(found.file.to_string())
}

#[test]
fn a_path_wins_over_the_installation_and_both_over_what_is_built_in() {
    let folder = Folder::new(
        "order",
        &[
            (
                "types/robot_msgs/msg/Arm.msg",
                "float64[] mine\nstd_msgs/Bool on\n",
            ),
            ("ws/src/repo/robot_msgs/msg/Arm.msg", "float64[] theirs\n"),
            (
                "ws/src/repo/robot_msgs/srv/Move.srv",
                "robot_msgs/Arm arm\n---\nbool ok\n",
            ),
            (
                "ws/src/repo/std_msgs/msg/Bool.msg",
                "bool data\nuint8 quality\n",
            ),
        ],
    );
    let environment = RosEnvironment {
        ros1: vec![folder.path("ws")],
        ros2: vec![],
    };
    let mut files = open(&[folder.path("types")], environment);
    assert!(files.faults().is_empty());
    let mut library = Library::new(TypeRegistry::bundle(Dialect::Ros1));
    let service = library
        .service(&name("robot_msgs/Move"), &mut files)
        .unwrap();
    let leaves: Vec<&str> = service
        .request()
        .leaves()
        .iter()
        .map(|l| l.path.as_str())
        .collect();
    assert_eq!(leaves, ["arm.mine", "arm.on.data", "arm.on.quality"]);
    let differs: Vec<_> = library
        .take_noted()
        .into_iter()
        .filter_map(|noted| match noted {
            messages::Noted::Differs {
                name,
                only_file,
                only_built_in,
                ..
            } => Some((name.to_string(), only_file, only_built_in)),
            messages::Noted::Read { .. } | messages::Noted::Refused { .. } => None,
        })
        .collect();
    let quality = vec!["uint8 quality".to_owned()];
    assert_eq!(differs, [("std_msgs/Bool".to_owned(), quality, vec![])]);
    assert!(
        file(
            &mut files,
            Dialect::Ros2,
            TextKind::Service,
            "robot_msgs/Move"
        )
        .is_none()
    );
}

#[test]
fn an_installation_of_ros_2_is_read_below_share_and_prefers_the_msg_to_the_idl_made_of_it() {
    let idl = "module nav { module msg { struct Leg { double knee; }; }; };";
    let folder = Folder::new(
        "ament",
        &[
            (
                "install/share/nav/package.xml",
                "<package><name>nav</name></package>",
            ),
            ("install/share/nav/msg/Leg.idl", idl),
            ("install/share/nav/msg/Hip.msg", "Leg leg\n"),
            ("install/share/nav/msg/Hip.idl", "broken"),
            ("install/lib/nav/msg/Other.msg", "bool x\n"),
        ],
    );
    let environment = RosEnvironment {
        ros1: vec![],
        ros2: vec![folder.path("install")],
    };
    let mut files = open(&[], environment);
    let mut library = Library::new(TypeRegistry::bundle(Dialect::Ros2));
    let hip = library.message(&name("nav/Hip"), &mut files).unwrap();
    assert_eq!(hip.leaves()[0].path, "leg.knee");
    assert!(
        library
            .file(TextKind::Message, &name("nav/Leg"))
            .unwrap()
            .ends_with("msg/Leg.idl")
    );
    assert!(file(&mut files, Dialect::Ros2, TextKind::Message, "nav/Other").is_none());
    assert_eq!(files.places(Dialect::Ros2), [AMENT_PREFIX_PATH]);
}

#[test]
fn what_is_no_regular_file_is_not_opened() {
    for file in ["/dev/null", "/"] {
        let refused = Disk.read(file).unwrap_err().to_string();
        assert!(refused.contains("not a regular file"), "{refused}");
    }
}

#[test]
fn what_one_ros_is_to_ignore_is_only_looked_into_for_the_other() {
    let package =
        "<package><name>robot_msgs</name><buildtool_depend>catkin</buildtool_depend></package>";
    let folder = Folder::new(
        "ignored",
        &[
            ("a/CATKIN_IGNORE", ""),
            ("a/old_msgs/msg/Arm.msg", "bool x\n"),
            ("b/AMENT_IGNORE", ""),
            ("b/ament_msgs/msg/Arm.msg", "bool x\n"),
            ("c/COLCON_IGNORE", ""),
            ("c/colcon_msgs/msg/Arm.msg", "bool x\n"),
            ("c/both_msgs/CATKIN_IGNORE", ""),
            ("c/both_msgs/msg/Arm.msg", "bool x\n"),
            ("d/.git/old_msgs/msg/Arm.msg", "bool x\n"),
            ("d/folder/package.xml", package),
            ("d/folder/msg/Arm.msg", "bool x\n"),
            ("d/folder/inner_msgs/msg/Arm.msg", "bool x\n"),
        ],
    );
    let environment = RosEnvironment {
        ros1: vec![folder.0.clone()],
        ros2: vec![],
    };
    let names = |files: &mut TypeFiles, dialect| -> Vec<String> {
        let names = files.names(dialect, TextKind::Message);
        names.iter().map(ToString::to_string).collect()
    };
    let mut files = open(&[], environment);
    assert_eq!(
        names(&mut files, Dialect::Ros1),
        ["ament_msgs/Arm", "colcon_msgs/Arm", "robot_msgs/Arm"],
        "the last by its package.xml, and none within it"
    );
    let mut files = open(std::slice::from_ref(&folder.0), RosEnvironment::default());
    assert_eq!(
        names(&mut files, Dialect::Ros2),
        ["inner_msgs/Arm", "old_msgs/Arm"]
    );
}

#[test]
fn a_file_that_does_not_parse_is_told_with_its_line_and_the_others_count() {
    let catkin =
        "<package><name>robot_msgs</name><buildtool_depend>catkin</buildtool_depend></package>";
    let folder = Folder::new(
        "faults",
        &[
            ("types/robot_msgs/package.xml", catkin),
            ("types/robot_msgs/msg/Bad.msg", "bool good\nint32 9lives\n"),
            ("types/robot_msgs/msg/Only2.msg", "string<=4 x\n"),
            ("types/robot_msgs/msg/Good.msg", "bool x\n"),
            (
                "types/robot_msgs/action/Turn.action",
                "float64 a\n---\nbool ok\n---\nfloat64 left\n",
            ),
            ("empty/readme", ""),
        ],
    );
    let paths = ["types", "empty", "nowhere", "types/robot_msgs/msg/Good.msg"]
        .map(|path| folder.path(path));
    let mut files = open(&paths, RosEnvironment::default());
    let faults = files.faults();
    let told: Vec<(usize, String)> = faults
        .into_iter()
        .map(|fault| match fault.what {
            PathFaultKind::Empty(why) | PathFaultKind::File(why) => {
                (fault.path, why.replace(&*folder.0.to_string_lossy(), ""))
            }
        })
        .collect();
    let expected = [
        (0, "/types/robot_msgs/msg/Bad.msg:2: expected a field name: letters, digits and `_`, beginning \
             with a letter: `int32 9lives`"),
        (0, "/types/robot_msgs/msg/Only2.msg:1: only ROS 2 has bounded types: `string<=4 x`"),
        (1, "/empty: it contains no definition files"),
        (2, "/nowhere: No such file or directory (os error 2)"),
    ]
    .map(|(path, why)| (path, why.to_owned()));
    assert_eq!(told, expected);
    let mut library = Library::new(TypeRegistry::bundle(Dialect::Ros1));
    assert!(
        library
            .message(&name("robot_msgs/Good"), &mut files)
            .is_ok()
    );
    let action = library
        .action(&name("robot_msgs/Turn"), &mut files)
        .unwrap();
    assert_eq!(action.goal().leaves()[0].path, "a");
    assert!(
        library
            .file(TextKind::Action, &name("robot_msgs/Turn"))
            .is_some()
    );
}

#[test]
fn a_single_file_is_of_the_package_around_its_folder() {
    let folder = Folder::new("single", &[("robot_msgs/msg/Arm.msg", "bool x\n")]);
    let mut files = open(
        &[folder.path("robot_msgs/msg/Arm.msg")],
        RosEnvironment::default(),
    );
    for dialect in [Dialect::Ros1, Dialect::Ros2] {
        assert!(file(&mut files, dialect, TextKind::Message, "robot_msgs/Arm").is_some());
    }
}

/// Definitions of a robot in two folders, and two of the tutorials with well-known checksums.
const ROBOT: [(&str, &str); 8] = [
    (
        "a/robot_msgs/msg/Joint.msg",
        "uint8 OFF=0  # no power\nstring name\nfloat64 angle\n",
    ),
    (
        "a/robot_msgs/msg/Arm.msg",
        "Header header\nJoint[] joints\nother_msgs/Tool tool\n",
    ),
    (
        "a/robot_msgs/srv/Move.srv",
        "uint8 FAST=1\nArm target\nduration within\n---\nuint8 LATE=2\nbool success\nother_msgs/Tool[2] tools\n",
    ),
    ("a/robot_msgs/srv/Stop.srv", "---\n"),
    (
        "a/robot_msgs/action/Pick.action",
        "Arm arm\n---\nother_msgs/Tool held\n---\nfloat32 progress\n",
    ),
    ("b/other_msgs/msg/Tool.msg", "int32 id\ntime since\n"),
    (
        "b/rospy_tutorials/srv/AddTwoInts.srv",
        "int64 a\nint64 b\n---\nint64 sum\n",
    ),
    (
        "b/actionlib_tutorials/action/Fibonacci.action",
        "#goal definition\nint32 order\n---\n#result definition\nint32[] sequence\n---\n#feedback\nint32[] sequence\n",
    ),
];

/// Returns name and md5 of each service of the folders, and of each message of each action.
fn md5s(paths: &[PathBuf]) -> BTreeMap<String, String> {
    let mut files = open(paths, RosEnvironment::default());
    assert_eq!(files.faults(), []);
    let mut library = Library::new(TypeRegistry::bundle(Dialect::Ros1));
    let mut found = BTreeMap::new();
    for service in [
        "robot_msgs/Move",
        "robot_msgs/Stop",
        "rospy_tutorials/AddTwoInts",
    ] {
        let service_type = library.service(&name(service), &mut files).unwrap();
        found.insert(service.to_owned(), service_type.md5().to_owned());
    }
    for action in ["robot_msgs/Pick", "actionlib_tutorials/Fibonacci"] {
        let action = library.action(&name(action), &mut files).unwrap();
        for part in [
            action.action(),
            action.action_goal(),
            action.action_result(),
            action.action_feedback(),
            action.goal(),
            action.result(),
            action.feedback(),
        ] {
            found.insert(part.name().to_string(), part.md5().to_owned());
        }
    }
    found
}

#[test]
fn services_and_actions_of_type_paths_have_the_md5s_that_genmsg_computes() {
    let folder = Folder::new("md5", &ROBOT);
    let found = md5s(&[folder.path("a"), folder.path("b")]);
    assert_eq!(found.len(), 3 + 2 * 7);
    for (known, md5) in [
        (
            "rospy_tutorials/AddTwoInts",
            "6a2e34150c00229791cc89ff309fff21",
        ),
        (
            "actionlib_tutorials/FibonacciAction",
            "f59df5767bf7634684781c92598b2406",
        ),
        (
            "actionlib_tutorials/FibonacciGoal",
            "6889063349a00b249bd1661df429d822",
        ),
        (
            "actionlib_tutorials/FibonacciResult",
            "b81e37d2a31925a0e8ae261a8699cb79",
        ),
    ] {
        assert_eq!(found[known], md5, "{known}");
    }
    let script = concat!(
        env!("CARGO_MANIFEST_DIR"),
        "/../messages/tests/data/genmsg_md5.py"
    );
    let genmsg = std::process::Command::new("/usr/bin/python3")
        .arg(script)
        .arg(&folder.0)
        .output();
    let Some(told) = genmsg.ok().filter(|done| done.status.success()) else {
        eprintln!("skipped: Debian's python3-genmsg is missing");
        return;
    };
    let told = String::from_utf8(told.stdout).unwrap();
    let judged: BTreeMap<String, String> = told
        .lines()
        .filter_map(|line| line.split_once(' '))
        .map(|(name, md5)| (name.to_owned(), md5.to_owned()))
        .collect();
    assert_eq!(found, judged);
}

#[cfg(unix)]
#[test]
fn who_may_read_a_file_is_told_by_its_mode() {
    use std::os::unix::fs::PermissionsExt as _;
    let folder = Folder::new("readers", &[("cell.yaml", "{}")]);
    let path = folder.path("cell.yaml");
    for (mode, readers) in [
        (0o600, None),
        (0o622, None),
        (0o640, Some(FileReaders::Group)),
        (0o604, Some(FileReaders::Everybody)),
        (0o644, Some(FileReaders::Everybody)),
    ] {
        std::fs::set_permissions(&path, std::fs::Permissions::from_mode(mode)).unwrap();
        let told = Disk.readers(path.to_str().unwrap());
        assert_eq!(told, readers, "{mode:o}");
    }
    assert_eq!(Disk.readers("/nowhere/cell.yaml"), None);
}

#[test]
fn what_is_looked_at_is_told_of_and_a_file_that_does_not_count_any_more_is_named() {
    let folder = Folder::new(
        "seen",
        &[
            ("types/robot_msgs/msg/Arm.msg", "bool x\n"),
            ("types/robot_msgs/msg/Leg.msg", "bool 9x\n"),
        ],
    );
    let read = || {
        let mut seen = Vec::new();
        let read = TypePaths::read(&[folder.path("types")], &mut |path| {
            seen.push(path.strip_prefix(&folder.0).unwrap().to_owned());
        });
        (read, seen)
    };
    let (before, seen) = read();
    for path in [
        "types",
        "types/robot_msgs",
        "types/robot_msgs/package.xml",
        "types/robot_msgs/msg",
        "types/robot_msgs/msg/Arm.msg",
        "types/robot_msgs/msg/Leg.msg",
    ] {
        assert!(seen.contains(&PathBuf::from(path)), "{path}: {seen:?}");
    }
    let (same, _) = read();
    assert_eq!(same, before);
    assert_eq!(
        (same.fingerprint(), same.differing(&before)),
        (before.fingerprint(), 0)
    );
    let mut same = same;
    same.keep(&before);
    assert_eq!(same.kept(), [""; 0], "it never counted");

    let arm = folder.path("types/robot_msgs/msg/Arm.msg");
    std::fs::write(&arm, "bool x\nbool y\n").unwrap();
    let (changed, _) = read();
    assert_ne!(changed.fingerprint(), before.fingerprint());
    assert_eq!(changed.differing(&before), 1);
    std::fs::write(&arm, "bool x\nbool\n").unwrap();
    let (mut faulty, _) = read();
    assert_eq!(faulty.differing(&before), 1);
    faulty.keep(&before);
    assert!(
        matches!(faulty.kept(), [one] if one.contains("Arm.msg:2: ")),
        "{:?}",
        faulty.kept()
    );
    assert_eq!(faulty.differing(&before), 0, "it has the text of before");
    std::fs::write(folder.path("types/robot_msgs/msg/Leg.msg"), "bool x\n").unwrap();
    let (mut other, _) = read();
    other.keep(&faulty);
    assert_eq!((other.kept().len(), other.differing(&before)), (1, 1));

    std::fs::remove_file(&arm).unwrap();
    let (mut without, _) = read();
    without.keep(&before);
    assert_eq!(
        (without.kept().len(), without.differing(&before)),
        (0, 2),
        "one file less, and one more"
    );
    assert!(!without.is_without_folder());
}

#[test]
fn a_folder_that_is_gone_or_has_none_left_keeps_its_definitions() {
    let folder = Folder::new(
        "gone",
        &[
            ("a/robot_msgs/msg/Arm.msg", "bool x\n"),
            ("b/other_msgs/msg/Arm.msg", "bool x\n"),
        ],
    );
    let paths = [folder.path("a"), folder.path("b")];
    let read = || TypePaths::read(&paths, &mut |_| {});
    let before = read();
    std::fs::rename(folder.path("a"), folder.path("away")).unwrap();
    std::fs::remove_file(folder.path("b/other_msgs/msg/Arm.msg")).unwrap();
    let mut gone = read();
    gone.keep(&before);
    assert_eq!((gone.kept().len(), gone.differing(&before)), (2, 0));
    assert!(gone.is_without_folder());
    assert_eq!(gone.faults(), []);

    std::fs::rename(folder.path("away"), folder.path("a")).unwrap();
    let mut back = read();
    back.keep(&gone);
    assert!(matches!(back.kept(), [one] if one.contains("/b: ")));
    let mut first = read();
    first.keep(&TypePaths::default());
    assert_eq!(first.faults().len(), 1, "it never counted");
}

#[test]
fn a_type_is_kept_with_what_it_needs() {
    let folder = Folder::new(
        "whole",
        &[
            ("types/robot_msgs/srv/Move.srv", "Arm arm\n---\n"),
            ("types/robot_msgs/msg/Arm.msg", "Leg leg\n"),
            ("types/robot_msgs/msg/Leg.msg", "bool x\n"),
            ("types/robot_msgs/msg/Other.msg", "bool x\n"),
        ],
    );
    let paths = [folder.path("types")];
    let read = || TypePaths::read(&paths, &mut |_| {});
    let before = read();
    for file in ["Leg", "Other"] {
        let file = format!("types/robot_msgs/msg/{file}.msg");
        std::fs::remove_file(folder.path(&file)).unwrap();
    }
    std::fs::write(folder.path("types/robot_msgs/msg/Arm.msg"), "Nowhere leg\n").unwrap();
    let mut without = read();
    let service = name("robot_msgs/Move");
    without.keep_whole(&before, Dialect::Ros1, TextKind::Service, &service);
    assert!(matches!(without.kept(), [one] if one.contains("a type that `robot_msgs/Move` uses")));
    for (message, is_there) in [("Leg", true), ("Other", false)] {
        let message = name(&format!("robot_msgs/{message}"));
        let file = without.file(Dialect::Ros1, TextKind::Message, &message);
        assert_eq!(file.is_some(), is_there, "{message}");
    }
    assert_eq!(without.differing(&before), 1, "for either ROS");
}

#[test]
fn files_are_read_within_their_bound() {
    let folder = Folder::new("bounded", &[("a", "abc")]);
    let file = folder.path("a");
    assert_eq!(read_bounded(&file, 3).unwrap(), b"abc");
    assert_eq!(
        read_bounded(&file, 2).unwrap_err().to_string(),
        "it is larger than 0 KiB"
    );
    let endless = Path::new("/dev/zero");
    assert_eq!(
        read_bounded(endless, 64 << 10).unwrap_err().to_string(),
        "it is larger than 64 KiB"
    );
    assert_eq!(
        read_text_file(endless).unwrap_err().to_string(),
        "it is larger than 8 MiB"
    );
}

#[test]
fn packages_are_found_by_the_name_in_their_manifest_and_names_are_no_paths() {
    let manifest = "<package><name>arm_description</name></package>";
    let folder = Folder::new(
        "packages",
        &[
            ("ws/src/repo/arm/package.xml", manifest),
            ("ws/src/repo/arm/nested/package.xml", "<name>nested</name>"),
            ("ws/src/off/CATKIN_IGNORE", ""),
            ("ws/src/off/hidden/package.xml", "<name>hidden</name>"),
            ("prefix/share/base_description/package.xml", ""),
        ],
    );
    let environment = RosEnvironment {
        ros1: vec![folder.path("ws/src")],
        ros2: vec![folder.path("prefix")],
    };
    assert!(!environment.is_empty() && RosEnvironment::default().is_empty());
    let found = |name: &str| environment.package(name);
    let arm = folder.path("ws/src/repo/arm");
    assert_eq!(found("arm_description"), Some(arm));
    let base = folder.path("prefix/share/base_description");
    assert_eq!(found("base_description"), Some(base));
    for missing in ["arm", "nested", "hidden", "", ".", "..", "../share", "/"] {
        assert_eq!(found(missing), None, "{missing}");
    }
}
