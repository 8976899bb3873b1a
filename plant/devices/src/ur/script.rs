//! The statements of URScript that the simulator supports.

/// A statement.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Statement {
    /// `movel` or `movej` to a pose: x, y, z and a rotation vector.
    Move {
        linear: bool,
        to: [f64; 6],
        acceleration: f64,
        speed: f64,
    },
    /// `movej` to positions of the joints, rad.
    Turn {
        to: [f64; 6],
        acceleration: f64,
        speed: f64,
    },
    /// `stopl` and `stopj`
    Stop,
    /// `write_output_integer_register`
    Register { number: usize, value: i32 },
    /// `sleep`, s
    Sleep(f64),
    /// `set_payload`: kg, and the centre of mass at the flange, m.
    Payload { mass: f64, center: [f64; 3] },
    /// A statement without effect here: `textmsg`, `set_tcp`.
    Nothing,
}

/// A line that is no supported statement, shortened.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("{0}")]
pub(crate) struct UnknownStatement(pub(crate) String);

/// Removes complete programs from the front of the received text: programs between `def` and `end`,
/// and single lines. A program with an unknown statement is returned as an error with its line.
pub(crate) fn programs(text: &mut String) -> Vec<Result<Vec<Statement>, UnknownStatement>> {
    let mut programs = Vec::new();
    while let Some((program, length)) = first(text) {
        text.drain(..length);
        let statements: Vec<&str> = program.iter().map(String::as_str).collect();
        if !statements.is_empty() {
            programs.push(statements.into_iter().map(statement).collect());
        }
    }
    programs
}

/// Returns the lines of the first program without its frame, and the length of its text.
fn first(text: &str) -> Option<(Vec<String>, usize)> {
    let mut lines = Vec::new();
    let mut length = 0;
    let mut inside = false;
    for line in text.split_inclusive('\n') {
        if !line.ends_with('\n') {
            return None;
        }
        length += line.len();
        let line = line.split('#').next().unwrap_or_default().trim();
        match line {
            "" if inside => {}
            "" => return Some((lines, length)),
            "end" if inside => return Some((lines, length)),
            _ if line.starts_with("def ") && !inside => inside = true,
            _ => {
                lines.push(line.to_owned());
                if !inside {
                    return Some((lines, length));
                }
            }
        }
    }
    None
}

fn statement(line: &str) -> Result<Statement, UnknownStatement> {
    read(line).ok_or_else(|| UnknownStatement(line.chars().take(80).collect()))
}

fn read(line: &str) -> Option<Statement> {
    let (name, rest) = line.split_once('(')?;
    let inner = rest.trim_end().strip_suffix(')')?;
    Some(match name.trim() {
        verb @ ("movel" | "movej") => {
            let inner = inner.trim();
            let (target, is_pose) = match inner.strip_prefix("p[") {
                Some(pose) => (pose, true),
                None => (inner.strip_prefix('[')?, false),
            };
            let (target, rest) = target.split_once(']')?;
            let to = numbers(target)?;
            let given: Vec<&str> = rest
                .split(',')
                .map(str::trim)
                .filter(|part| !part.is_empty())
                .collect();
            let value = |place: usize, name: &str, usual: f64| {
                let named = given.iter().find_map(|part| {
                    let (key, value) = part.split_once('=')?;
                    (key.trim() == name).then_some(value.trim())
                });
                let by_place = given.get(place).copied().filter(|part| !part.contains('='));
                match named.or(by_place) {
                    Some(text) => text.parse().ok().filter(|value| *value > 0.0),
                    None => Some(usual),
                }
            };
            let linear = verb == "movel";
            let acceleration = value(0, "a", if linear { 1.2 } else { 1.4 })?;
            let speed = value(1, "v", if linear { 0.25 } else { 1.05 })?;
            match (is_pose, linear) {
                (true, _) => Statement::Move {
                    linear,
                    to,
                    acceleration,
                    speed,
                },
                (false, false) => Statement::Turn {
                    to,
                    acceleration,
                    speed,
                },
                // Without kinematics, the pose of the tool is unknown.
                (false, true) => return None,
            }
        }
        "stopl" | "stopj" => {
            let deceleration: f64 = inner.split(',').next()?.trim().parse().ok()?;
            (deceleration > 0.0).then_some(Statement::Stop)?
        }
        "write_output_integer_register" => {
            let (number, value) = inner.split_once(',')?;
            let number = number.trim().parse().ok().filter(|number| *number < 48)?;
            Statement::Register {
                number,
                value: value.trim().parse().ok()?,
            }
        }
        "sleep" => Statement::Sleep(
            inner
                .trim()
                .parse()
                .ok()
                .filter(|s| (0.0..=3600.0).contains(s))?,
        ),
        "set_payload" => {
            let (mass, center) = match inner.split_once(',') {
                Some((mass, list)) => {
                    let list = list.trim().strip_prefix('[')?.strip_suffix(']')?;
                    (mass, numbers(list)?)
                }
                None => (inner, [0.0; 3]),
            };
            let mass = mass.trim().parse().ok();
            let mass = mass.filter(|mass: &f64| mass.is_finite() && *mass >= 0.0)?;
            Statement::Payload { mass, center }
        }
        "textmsg" | "set_tcp" => Statement::Nothing,
        _ => return None,
    })
}

/// Returns a list of `N` numbers.
fn numbers<const N: usize>(text: &str) -> Option<[f64; N]> {
    let numbers: Vec<f64> = text
        .split(',')
        .map(|part| part.trim().parse().ok().filter(|n: &f64| n.is_finite()))
        .collect::<Option<_>>()?;
    numbers.try_into().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_program_is_taken_when_it_is_whole() {
        let mut text = "def x():\n  movel(p[0.1,0,0,0,0,0], a=2, v=0.5)".to_owned();
        assert!(programs(&mut text).is_empty());
        text.push_str("\n\n  write_output_integer_register(25, -3) # done\nend\nstopl(2.0)\nmovej(p[0,0,0,0,0,0], 1, 2)\nmovej([0,1,0,0,0,-1.5], a=3, v=2)\nset_payload(1.5, [0, 0, 0.05])\n");
        let expected = [
            Ok(vec![
                Statement::Move {
                    linear: true,
                    to: [0.1, 0.0, 0.0, 0.0, 0.0, 0.0],
                    acceleration: 2.0,
                    speed: 0.5,
                },
                Statement::Register {
                    number: 25,
                    value: -3,
                },
            ]),
            Ok(vec![Statement::Stop]),
            Ok(vec![Statement::Move {
                linear: false,
                to: [0.0; 6],
                acceleration: 1.0,
                speed: 2.0,
            }]),
            Ok(vec![Statement::Turn {
                to: [0.0, 1.0, 0.0, 0.0, 0.0, -1.5],
                acceleration: 3.0,
                speed: 2.0,
            }]),
            Ok(vec![Statement::Payload {
                mass: 1.5,
                center: [0.0, 0.0, 0.05],
            }]),
        ];
        assert_eq!(programs(&mut text), expected);
        assert_eq!(text, "");
    }

    #[test]
    fn what_is_not_understood_is_told_by_its_line() {
        for wrong in [
            "movel(p[0,0,0,0,0], a=1)",
            "movel(p[0,0,0,0,0,nan], a=1)",
            "movej(p[0,0,0,0,0,0], v=0)",
            "movej([0,0,0,0,0])",
            "movel([0,0,0,0,0,0])",
            "write_output_integer_register(48, 1)",
            "servoj(1)",
            "set_payload(-1)",
            "set_payload(1, [0, 0])",
            "stopl()",
            "x",
        ] {
            let mut text = format!("{wrong}\n");
            assert_eq!(
                programs(&mut text),
                [Err(UnknownStatement(wrong.to_owned()))]
            );
        }
    }
}
