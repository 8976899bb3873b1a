//! Extents of whole files, and the files that must not have any.

#![expect(clippy::unwrap_used, clippy::panic, reason = "a test may")]

use std::cell::Cell;
use std::path::Path;

use step_files::{ShapeFault, StepFault, StepProducts};

fn text(name: &str) -> String {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR"));
    let path = match name {
        "cover.step" => folder.join("../../examples/plant/cover.step"),
        name => folder.join("tests/data").join(name),
    };
    std::fs::read_to_string(path).unwrap()
}

/// Returns the bounds of the last product in millimetres.
fn bounds(text: &str) -> [f64; 6] {
    let read = StepProducts::read(text.as_bytes()).unwrap();
    assert_eq!(read.findings, []);
    let extents = read.products.last().unwrap().extents.unwrap();
    let ([a, b, c], [d, e, f]) = (extents.min, extents.max);
    [a, b, c, d, e, f].map(|metres| metres * 1e3)
}

/// Returns the only finding, and checks that its product has no extents.
fn finding(text: &str) -> String {
    let read = StepProducts::read(text.as_bytes()).unwrap();
    assert!(
        read.products
            .iter()
            .all(|product| product.extents.is_none()),
        "{read:?}"
    );
    let [found] = read.findings.as_slice() else {
        panic!("{read:?}")
    };
    assert!(found.line.is_some(), "{found}");
    found.to_string()
}

/// Replaces the record of an entity. `number` counts the records that contain `of`.
fn changed(name: &str, (of, number): (&str, usize), from: &str, to: &str) -> String {
    let text = text(name);
    let line = text
        .lines()
        .filter(|line| line.contains(of))
        .nth(number)
        .unwrap();
    assert!(line.contains(from), "{line}");
    text.replace(line, &line.replacen(from, to, 1))
}

#[test]
fn extents_are_those_of_the_drawing() {
    let expected = [
        ("cover.step", [0.0, 0.0, 0.0, 31.0, 40.0, 20.0]),
        ("half_round.step", [-25.4, 0.0, 0.0, 25.4, 25.4, 50.8]),
        ("dome.step", [-10.0, -10.0, 0.0, 10.0, 10.0, 25.0]),
        ("tip.step", [-5.0, -5.0, -5.0, 5.0, 5.0, 0.0]),
        // A quarter of the middle control point, which is 8 mm above the others.
        ("bump.step", [0.0, 0.0, 0.0, 20.0, 30.0, 12.0]),
        ("ring.step", [-4.0, -23.0, -22.0, 6.0, 27.0, 28.0]),
        // Blocks of 10 x 20 x 30 mm, turned by 30 degrees and by 90, in a cell in inches.
        (
            "assembly.step",
            [-22.3205, 0.0, 254.0, 0.0, 108.6603, 324.0],
        ),
    ];
    for (name, expected) in expected {
        let found = bounds(&text(name));
        for (found, expected) in found.iter().zip(expected) {
            assert!(
                (found - expected).abs() < 0.05,
                "{name}: {found} {expected}"
            );
        }
    }
}

#[test]
fn an_assembly_has_its_parts_with_their_placements() {
    let read = StepProducts::read(text("assembly.step").as_bytes()).unwrap();
    let ids: Vec<&str> = read.products.iter().map(|product| &*product.id).collect();
    assert_eq!(ids, ["P-1", "A-1", "A-2"]);
    let [block, pair, cell] = read.products.as_slice() else {
        panic!("{read:?}")
    };
    let names: Vec<&str> = pair.occurrences.iter().map(|part| &*part.name).collect();
    assert_eq!(names, ["left", "right"]);
    assert!(
        pair.occurrences
            .iter()
            .all(|part| part.part == block.entity)
    );
    let pose = cell.occurrences[0].pose.unwrap();
    assert!((pose.position[2] - 0.254).abs() < 1e-9, "{pose:?}");
    assert!((pose.axes[0][1] - 1.0).abs() < 1e-9, "{pose:?}");
}

/// Records whose last flag is wrong once it is changed, with a part of the finding.
const WRONG_SENSES: [(&str, (&str, usize), &str); 12] = [
    // The other half of the circle would be as closed, and twice as far.
    (
        "half_round.step",
        ("EDGE_CURVE", 0),
        "do not enclose it on their left",
    ),
    ("half_round.step", ("ADVANCED_FACE", 2), "do not enclose it"),
    ("half_round.step", ("ADVANCED_FACE", 0), "do not enclose it"),
    (
        "cover.step",
        ("EDGE_CURVE", 3),
        "contradicts the order of its vertices",
    ),
    ("cover.step", ("ADVANCED_FACE", 0), "do not enclose it"),
    (
        "cover.step",
        ("FACE_OUTER_BOUND", 1),
        "in the same direction",
    ),
    ("dome.step", ("EDGE_CURVE", 0), "do not enclose it"),
    ("dome.step", ("EDGE_CURVE", 1), "do not enclose it"),
    // Half of the ball would be within the cylinder, and beside its wall.
    ("dome.step", ("ADVANCED_FACE", 2), "lie on each other"),
    ("tip.step", ("ADVANCED_FACE", 1), "do not enclose it"),
    ("bump.step", ("ADVANCED_FACE", 5), "do not enclose it"),
    (
        "bump.step",
        ("EDGE_CURVE", 0),
        "contradicts the order of its vertices",
    ),
];

#[test]
fn a_wrong_sense_is_a_finding() {
    for (name, record, expected) in WRONG_SENSES {
        let line = text(name);
        let line = line
            .lines()
            .filter(|line| line.contains(record.0))
            .nth(record.1);
        let is_true = line.unwrap().ends_with(".T.);");
        let (from, to) = if is_true {
            (".T.);", ".F.);")
        } else {
            (".F.);", ".T.);")
        };
        let found = finding(&changed(name, record, from, to));
        assert!(found.contains(expected), "{name} {record:?}: {found}");
    }
}

#[test]
fn an_open_shell_is_a_finding() {
    let cover = text("cover.step");
    let shell = cover
        .lines()
        .find(|line| line.contains("CLOSED_SHELL"))
        .unwrap();
    let first = shell.find("(#").unwrap() + 1;
    let second = shell.find(",#").unwrap() + 1;
    let missing = format!("{}{}", &shell[..first], &shell[second..]);
    let found = finding(&cover.replace(shell, &missing));
    assert!(
        found.contains("so that the shell is open; a face is missing"),
        "{found}"
    );

    let found = finding(&cover.replace("CLOSED_SHELL", "OPEN_SHELL"));
    assert!(
        found.contains("OPEN_SHELL, which is not supported here"),
        "{found}"
    );

    let ring = cover
        .lines()
        .find(|line| line.contains("EDGE_LOOP"))
        .unwrap();
    let cut = format!("{}));", &ring[..ring.rfind(',').unwrap()]);
    let found = finding(&cover.replace(ring, &cut));
    assert!(
        found.contains("does not begin where the edge before it ends"),
        "{found}"
    );
}

#[test]
fn moved_points_and_other_sizes_are_findings() {
    for (name, record, from, to, expected) in [
        ("cover.step", ("(31.,", 0), "31.,", "30.9,", "mm off"),
        (
            "half_round.step",
            ("CIRCLE", 0),
            "1.)",
            "1.01)",
            "mm off the curve",
        ),
        (
            "half_round.step",
            ("CYLINDRICAL", 0),
            ",1.)",
            ",1.01)",
            "mm off its surface",
        ),
        (
            "dome.step",
            ("SPHERICAL", 0),
            "10.)",
            "10.1)",
            "mm off its surface",
        ),
        (
            "ring.step",
            ("TOROIDAL", 0),
            "20.,",
            "20.1,",
            "mm off its surface",
        ),
        (
            "ring.step",
            ("TOROIDAL", 0),
            "20.,5.",
            "5.,20.",
            "radius of 20 mm",
        ),
        ("tip.step", ("CONICAL", 0), "45.", "95.", "half angle"),
        ("tip.step", ("CONICAL", 0), "45.)", "1.0E300)", "half angle"),
        (
            "bump.step",
            ("(10.,0.,10.)", 0),
            "(10.,0.,",
            "(10.,0.1,",
            "mm off its surface",
        ),
        (
            "bump.step",
            ("(3,3),(3,3)", 0),
            "(0.,1.)",
            "(1.,0.)",
            "knots do not rise",
        ),
        (
            "cover.step",
            ("(31.,40.,20.)", 0),
            "31.,",
            "1.0E200,",
            "beyond 1000 m",
        ),
    ] {
        let text = changed(name, record, from, to);
        let found = finding(&text);
        assert!(found.contains(expected), "{name} {record:?}: {found}");
    }
}

#[test]
fn shapes_without_a_solid_and_units_are_findings() {
    for (name, from, to, expected) in [
        (
            "cover.step",
            "MANIFOLD_SOLID_BREP",
            "FACETED_BREP",
            "FACETED_BREP, which is not",
        ),
        (
            "cover.step",
            "PLANE(",
            "OFFSET_SURFACE(",
            "OFFSET_SURFACE, which is not",
        ),
        (
            "half_round.step",
            "CIRCLE(",
            "PARABOLA(",
            "PARABOLA, which is not",
        ),
        (
            "cover.step",
            "SI_UNIT(.MILLI.,.METRE.)",
            "SI_UNIT(.MILLI.,.GRAM.)",
            "the unit is not",
        ),
        (
            "cover.step",
            "LENGTH_UNIT()",
            "MASS_UNIT()",
            "0 units of length",
        ),
        (
            "cover.step",
            "SHAPE_DEFINITION_REPRESENTATION(",
            "X(",
            "has no shape",
        ),
    ] {
        let found = finding(&text(name).replace(from, to));
        assert!(found.contains(expected), "{name} {from}: {found}");
    }
}

#[test]
fn cyclic_and_unplaced_assemblies_have_no_extents() {
    let assembly = text("assembly.step");
    let usage = assembly
        .lines()
        .find(|line| line.contains("'left'"))
        .unwrap();
    let references: Vec<&str> = usage.split(',').skip(3).take(2).collect();
    let [parent, child] = references.as_slice() else {
        panic!("{usage}")
    };
    let turned = usage.replace(&format!("{parent},{child}"), &format!("{parent},{parent}"));
    let read = StepProducts::read(assembly.replace(usage, &turned).as_bytes()).unwrap();
    assert_eq!(read.findings.len(), 2, "{read:?}");
    assert!(read.products[0].extents.is_some());
    assert!(
        read.products[1..]
            .iter()
            .all(|product| product.extents.is_none())
    );

    let place = "CONTEXT_DEPENDENT_SHAPE_REPRESENTATION(";
    let read = StepProducts::read(assembly.replacen(place, "X(", 1).as_bytes()).unwrap();
    let shown: Vec<String> = read.findings.iter().map(ToString::to_string).collect();
    assert!(
        shown[0].contains("the occurrence has 0 placements"),
        "{shown:?}"
    );
    assert!(shown[1].contains("has no proven extents"), "{shown:?}");
}

#[test]
fn files_that_are_no_products_are_refused() {
    let cover = text("cover.step");
    let half = StepProducts::read(&cover.as_bytes()[..cover.len() / 2]);
    assert!(matches!(half, Err(StepFault::Syntax { .. })), "{half:?}");
    let ifc = StepProducts::read(cover.replace("AUTOMOTIVE_DESIGN", "IFC4").as_bytes());
    assert!(matches!(ifc, Err(StepFault::Schema { .. })), "{ifc:?}");
    let none = StepProducts::read(cover.replace("PRODUCT_DEFINITION(", "X(").as_bytes());
    assert_eq!(none, Err(StepFault::NoProduct));
    let deep = cover.replace(
        "'Cover'",
        &format!("{}{}", "(".repeat(9999), ")".repeat(9999)),
    );
    let deep = StepProducts::read(deep.as_bytes());
    assert!(matches!(deep, Err(StepFault::TooMany { .. })), "{deep:?}");
}

#[test]
fn a_reading_ends_when_its_time_is_over() {
    let cover = text("cover.step");
    // Returns what is read if the time is over at the look with this number.
    let until = |over: u32| {
        let looks = Cell::new(0);
        let is_over = || {
            looks.set(looks.get() + 1);
            looks.get() >= over
        };
        let read = StepProducts::read_until(cover.as_bytes(), &is_over);
        (read, looks.get())
    };
    let (late, looks) = until(1);
    assert!(matches!(late, Err(StepFault::Late { line }) if line > 1));
    assert_eq!(looks, 1);
    // The records are read, and the solids are not.
    let (late, looks) = until(2);
    let late = late.unwrap();
    assert_eq!((late.products.len(), looks), (1, 2));
    let [found] = late.findings.as_slice() else {
        panic!("{late:?}")
    };
    assert_eq!(
        (&found.fault, late.products[0].extents),
        (&ShapeFault::Late, None)
    );
    let (read, _) = until(u32::MAX);
    assert_eq!(read, StepProducts::read(cover.as_bytes()));
}

#[test]
fn a_deep_assembly_ends_within_bounds() {
    // Each of 60 levels has the level below twice: 2^60 blocks.
    let base = text("assembly.step");
    let cut = base.find("ENDSEC;\nEND-ISO").unwrap();
    let find = |what: &str| {
        let line = base.lines().find(|line| line.contains(what)).unwrap();
        line.split('=').next().unwrap().to_owned()
    };
    let (context, origin) = (find("GLOBAL_UNIT_ASSIGNED"), find("AXIS2_PLACEMENT_3D('',"));
    let mut all = base[..cut].to_owned();
    let (mut part, mut shape) = (find("PRODUCT_DEFINITION('"), find("ADVANCED_BREP_SHAPE"));
    let records = base.lines().collect::<Vec<_>>();
    let formation = records
        .iter()
        .find(|line| line.contains("PRODUCT_DEFINITION_FORMATION"));
    let formation = formation.unwrap().split('=').next().unwrap();
    let origin = if origin.is_empty() {
        "#1".to_owned()
    } else {
        origin
    };
    let last = format!("({origin}),{context}");
    let shape_items = base
        .lines()
        .find(|line| line.starts_with(&format!("{shape}=")))
        .unwrap();
    let origin_of_block = shape_items
        .split('(')
        .nth(2)
        .unwrap()
        .split(',')
        .next()
        .unwrap();
    let mut next = 10_000;
    for _ in 0..60 {
        let mut id = || {
            next += 1;
            format!("#{next}")
        };
        let (pd, pds, rep) = (id(), id(), id());
        all += &format!("{pd}=PRODUCT_DEFINITION('','',{formation},$);\n");
        all += &format!("{pds}=PRODUCT_DEFINITION_SHAPE('','',{pd});\n");
        all += &format!(
            "{rep}=SHAPE_REPRESENTATION('',({origin_of_block}),{});\n",
            last.rsplit(',').next().unwrap()
        );
        all += &format!("{}=SHAPE_DEFINITION_REPRESENTATION({pds},{rep});\n", id());
        for _ in 0..2 {
            let (usage, of, move_, relation) = (id(), id(), id(), id());
            all += &format!("{usage}=NEXT_ASSEMBLY_USAGE_OCCURRENCE('','','',{pd},{part},$);\n");
            all += &format!("{of}=PRODUCT_DEFINITION_SHAPE('','',{usage});\n");
            all += &format!(
                "{move_}=ITEM_DEFINED_TRANSFORMATION('','',{origin_of_block},{origin_of_block});\n"
            );
            all += &format!(
                "{relation}=(REPRESENTATION_RELATIONSHIP('','',{shape},{rep})REPRESENTATION_RELATIONSHIP_WITH_TRANSFORMATION({move_})SHAPE_REPRESENTATION_RELATIONSHIP());\n"
            );
            all += &format!(
                "{}=CONTEXT_DEPENDENT_SHAPE_REPRESENTATION({relation},{of});\n",
                id()
            );
        }
        (part, shape) = (pd, rep);
    }
    all += &base[cut..];
    let read = StepProducts::read(all.as_bytes()).unwrap();
    assert_eq!(read.products.len(), 63);
    let deepest = read.products.last().unwrap().extents;
    let sizes = deepest.map(|extents| extents.size().map(|size| (size * 1e3).round()));
    // All copies are at one place; more than 64 levels of shapes have a finding instead.
    assert!(
        sizes.is_none() || sizes == Some([10.0, 20.0, 30.0]),
        "{sizes:?}"
    );
}

#[test]
fn no_flag_of_a_shape_changes_its_extents_unnoticed() {
    let names = ["half_round", "dome", "tip", "bump", "ring", "cover"];
    let records = ["=ADVANCED_FACE", "=EDGE_CURVE", "=ORIENTED_EDGE", "=FACE_"];
    let (mut noticed, mut kept) = (0, 0);
    for name in names.map(|name| format!("{name}.step")) {
        let text = text(&name);
        let expected = bounds(&text);
        for (at, line) in text.lines().enumerate() {
            if !records.iter().any(|record| line.contains(record)) {
                continue;
            }
            let flipped = match line.strip_suffix(".T.);") {
                Some(rest) => format!("{rest}.F.);"),
                None => format!("{}.T.);", line.strip_suffix(".F.);").unwrap()),
            };
            let lines = text.lines().enumerate();
            let lines = lines.map(|(number, line)| if number == at { &flipped } else { line });
            let changed: Vec<&str> = lines.collect();
            let read = StepProducts::read(changed.join("\n").as_bytes()).unwrap();
            match read.products[0].extents {
                None => noticed += 1,
                Some(_) => {
                    let found = bounds(&changed.join("\n"));
                    let is_same = found
                        .iter()
                        .zip(expected)
                        .all(|(a, b)| (a - b).abs() < 1e-6);
                    assert!(is_same, "{name}: {line}: {found:?}");
                    kept += 1;
                }
            }
        }
    }
    assert!(noticed > 140 && kept < 10, "{noticed} {kept}");
}

#[test]
fn parts_and_shapes_that_are_not_read_leave_their_products_without_extents() {
    let assembly = text("assembly.step");
    let usage = assembly
        .lines()
        .find(|line| line.contains("'right'"))
        .unwrap();
    let number = usage.split('=').next().unwrap();
    let references: Vec<&str> = usage.split(',').skip(3).take(2).collect();
    let [parent, child] = references.as_slice() else {
        panic!("{usage}")
    };
    let quantified = format!(
        "{number}=(ASSEMBLY_COMPONENT_USAGE($)NEXT_ASSEMBLY_USAGE_OCCURRENCE()\
        PRODUCT_DEFINITION_RELATIONSHIP('2','right','',{parent},{child})\
        PRODUCT_DEFINITION_USAGE()QUANTIFIED_ASSEMBLY_COMPONENT_USAGE($));"
    );
    let between = format!("{parent},{child}");
    for changed in [
        usage.replace("NEXT_ASSEMBLY", "PROMISSORY"),
        usage.replace(&between, &format!("{parent},$")),
        usage.replace(&between, &format!("$,{child}")),
        usage.replace(&between, &format!("#999999,{child}")),
        quantified,
        // The placement of the part remains without the part.
        String::new(),
    ] {
        let read = StepProducts::read(assembly.replace(usage, &changed).as_bytes()).unwrap();
        let [_, pair, cell] = read.products.as_slice() else {
            panic!("{read:?}")
        };
        assert_eq!((pair.extents, cell.extents), (None, None), "{changed}");
        assert!(read.findings.iter().all(|found| found.line.is_some()));
    }
}

#[test]
fn a_shape_that_is_related_to_another_product_is_a_finding() {
    let related = text("related_products.step");
    let found = StepProducts::read(related.as_bytes()).unwrap().findings;
    assert!(
        found[0].to_string().contains("different contexts"),
        "{found:?}"
    );
    let related = related.replace("(#37),#63)", "(#37),#41)");
    let read = StepProducts::read(related.as_bytes()).unwrap();
    let shown: Vec<String> = read.findings.iter().map(ToString::to_string).collect();
    assert_eq!(shown.len(), 2, "{shown:?}");
    assert!(shown[0].contains("without a placement"), "{shown:?}");
    assert!(read.products.iter().all(|part| part.extents.is_none()));
}

#[test]
fn a_cone_needs_the_unit_of_its_angle() {
    let tip = text("tip.step");
    let without = tip.replace("PLANE_ANGLE_UNIT()", "SOLID_ANGLE_UNIT()");
    let found = finding(&without);
    assert!(found.contains("no unit of angles"), "{found}");

    // The same solid with its angle of 1 in degrees, and in radians.
    let read = StepProducts::read(text("two_angle_contexts.step").as_bytes()).unwrap();
    let depths = read.products.iter().map(|tip| tip.extents.unwrap().min[2]);
    let depths: Vec<f64> = depths.map(|metres| (metres * 1e5).round()).collect();
    assert_eq!(depths, [-28645.0, -321.0]);
}

#[test]
fn an_extrusion_of_a_curve_of_several_pieces_is_a_finding() {
    let found = finding(&text("zigzag.step"));
    assert!(
        found.contains("so that edges on the surface are not certain"),
        "{found}"
    );
}

#[test]
fn the_degree_of_a_spline_is_bounded() {
    let circle = text("dome.step");
    let line = circle
        .lines()
        .find(|line| line.contains("CIRCLE("))
        .unwrap();
    let number = line.split('=').next().unwrap();
    let curve =
        format!("{number}=BEZIER_CURVE('',9223372036854775807,(#1),.UNSPECIFIED.,.F.,.F.);");
    let found = finding(&circle.replace(line, &curve));
    assert!(found.contains("its degree is not from"), "{found}");
}

#[test]
fn edges_that_cross_and_slits_are_findings() {
    let found = finding(&text("crossing.step"));
    assert!(found.contains("do not enclose it"), "{found}");
    let found = finding(&text("slit.step"));
    assert!(found.contains("has no seam"), "{found}");
}

#[test]
fn a_product_of_an_unknown_formation_is_a_finding() {
    let read = StepProducts::read(text("dropped_product.step").as_bytes()).unwrap();
    assert_eq!(read.products.len(), 2, "{read:?}");
    let shown: Vec<String> = read.findings.iter().map(ToString::to_string).collect();
    let is_named = |found: &String| found.contains("PRODUCT_DEFINITION_FORMATION_X");
    assert!(shown.iter().any(is_named), "{shown:?}");
}

#[test]
fn representations_of_one_shape_need_the_same_context() {
    let cover = text("cover.step");
    let shape = cover
        .lines()
        .find(|line| line.contains("BREP_SHAPE_REPRESENTATION"))
        .unwrap();
    let number = shape.split('=').next().unwrap();
    let context = shape.rsplit('#').next().unwrap().trim_end_matches(");");
    let original = cover
        .lines()
        .find(|line| line.starts_with(&format!("#{context}=")))
        .unwrap();
    let end = cover.rfind("ENDSEC;").unwrap();
    let related = |of: &str| {
        let (_, copy) = original.split_once('=').unwrap();
        format!(
            "{}#90001={copy}\n#90002=SHAPE_REPRESENTATION('',(),#{of});\n\
            #90003=SHAPE_REPRESENTATION_RELATIONSHIP('','',{number},#90002);\n{}",
            &cover[..end],
            &cover[end..]
        )
    };
    assert_eq!(bounds(&related(context)), bounds(&cover));
    let found = finding(&related("90001"));
    assert!(found.contains("different contexts"), "{found}");
}
