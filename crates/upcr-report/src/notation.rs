//! A pose as other programs take it.

use serde::Serialize;
use upcr::Rigid;
use upcr::transform::{euler, quaternion};

/// A pose as text.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Notation {
    /// Its name, for a list to choose from.
    pub name: &'static str,
    /// What the numbers are.
    pub about: &'static str,
    /// The text.
    pub text: String,
}

/// The pose in all notations: numbers have the digits that they have in JSON, and read back the same.
pub fn notations(pose: &Rigid) -> Vec<Notation> {
    let rows = pose.to_rows();
    let t = line(pose.translation.as_slice());
    let q = quaternion::from_rotation(&pose.rotation);
    let angles = euler::from_rotation(&pose.rotation, euler::EulerOrder::Xyz).map(f64::to_degrees);
    let (axis, angle) = axis_angle(pose);
    vec![
        Notation {
            name: "4×4 matrix",
            about: "Row after row: T_target_source of the JSON, and what --init and --pose read.",
            text: rows.map(|row| line(&row)).join("\n"),
        },
        Notation {
            name: "Quaternion, translation",
            about: "w x y z of the unit quaternion, then x y z of the translation.",
            text: format!("{}\n{t}", line(&q)),
        },
        Notation {
            name: "Euler angles, translation",
            about: "Roll, pitch and yaw in degrees about the fixed axes x, y and z, in this order: \
                    R = Rz(yaw) Ry(pitch) Rx(roll). Then x y z of the translation.",
            text: format!("{}\n{t}", line(&angles)),
        },
        Notation {
            name: "Axis, angle, translation",
            about: "x y z of the unit axis and the angle in degrees, then x y z of the translation.",
            text: format!("{} {}\n{t}", line(&axis), number(angle.to_degrees())),
        },
        Notation {
            name: "PDAL stage",
            about: "A stage of a PDAL pipeline that moves the source.",
            text: format!(
                "{{\n  \"type\": \"filters.transformation\",\n  \"matrix\": \"{}\"\n}}",
                rows.map(|row| line(&row)).join("  ")
            ),
        },
        Notation {
            name: "CloudCompare",
            about: "For Edit, Apply transformation, or a file for -APPLY_TRANS; decimals without exponents. It is of the files' own \
                    coordinates: clouds with large ones are not to be shifted when they are opened.",
            text: rows.map(|row| row.map(|v| v.to_string()).join(" ")).join("\n"),
        },
    ]
}

/// Axis and angle in rad; of no turn the axis is x.
fn axis_angle(pose: &Rigid) -> ([f64; 3], f64) {
    let [w, x, y, z] = quaternion::from_rotation(&pose.rotation);
    let sine = x.hypot(y).hypot(z);
    if sine == 0.0 {
        return ([1.0, 0.0, 0.0], 0.0);
    }
    ([x / sine, y / sine, z / sine], 2.0 * sine.atan2(w))
}

/// As JSON has it.
fn number(value: f64) -> String {
    serde_json::Number::from_f64(value).map_or_else(|| value.to_string(), |number| number.to_string())
}

fn line(values: &[f64]) -> String {
    values.iter().map(|&v| number(v)).collect::<Vec<_>>().join(" ")
}

#[cfg(test)]
mod tests {
    use nalgebra::{Matrix3, Rotation3, Unit, Vector3, Vector6};
    use proptest::prelude::*;

    use super::*;

    fn numbers(text: &str) -> Vec<f64> {
        text.split_whitespace().map(|word| word.parse().unwrap()).collect()
    }

    /// The pose that each notation stands for, read by its own words and not by the code that wrote it.
    fn read_back(told: &[Notation]) -> Vec<(Matrix3<f64>, Vector3<f64>)> {
        let matrix = |n: &[f64]| {
            assert_eq!(n[12..], [0.0, 0.0, 0.0, 1.0]);
            let r = Matrix3::new(n[0], n[1], n[2], n[4], n[5], n[6], n[8], n[9], n[10]);
            (r, Vector3::new(n[3], n[7], n[11]))
        };
        let turn = |axis: Vector3<f64>, degrees: f64| {
            Rotation3::from_axis_angle(&Unit::new_normalize(axis), degrees.to_radians()).into_inner()
        };
        let shift = |n: &[f64]| Vector3::from_column_slice(&n[n.len() - 3..]);

        let q = numbers(&told[1].text);
        let (w, v) = (q[0], Vector3::new(q[1], q[2], q[3]));
        let cross = v.cross_matrix();
        let of_quaternion = Matrix3::identity() + cross * (2.0 * w) + cross * cross * 2.0;
        let e = numbers(&told[2].text);
        let of_angles = turn(Vector3::z(), e[2]) * turn(Vector3::y(), e[1]) * turn(Vector3::x(), e[0]);
        let a = numbers(&told[3].text);
        let stage: serde_json::Value = serde_json::from_str(&told[4].text).unwrap();
        assert_eq!(stage["type"], "filters.transformation");
        vec![
            matrix(&numbers(&told[0].text)),
            (of_quaternion, shift(&q)),
            (of_angles, shift(&e)),
            (turn(Vector3::new(a[0], a[1], a[2]), a[3]), shift(&a)),
            matrix(&numbers(stage["matrix"].as_str().unwrap())),
            matrix(&numbers(&told[5].text)),
        ]
    }

    proptest! {
        #[test]
        fn all_notations_stand_for_the_pose(
            omega in prop::array::uniform3(-3.0_f64..3.0),
            t in prop::array::uniform3(-1e7_f64..1e7),
        ) {
            let pose = Rigid::from_translation(t)
                * Rigid::exp(&Vector6::new(omega[0], omega[1], omega[2], 0.0, 0.0, 0.0));
            for (rotation, translation) in read_back(&notations(&pose)) {
                prop_assert!((rotation - pose.rotation).amax() < 1e-12);
                prop_assert_eq!(translation, pose.translation);
            }
        }
    }

    #[test]
    fn special_turns() {
        use std::f64::consts::{FRAC_PI_2, PI};
        for omega in [[0.0; 3], [PI, 0.0, 0.0], [0.0, 0.0, PI], [0.0, FRAC_PI_2, 0.0], [1e-9, 0.0, 0.0]] {
            let pose = Rigid::exp(&Vector6::new(omega[0], omega[1], omega[2], 1.0, 2.0, 3.0));
            for (k, (rotation, _)) in read_back(&notations(&pose)).into_iter().enumerate() {
                assert!((rotation - pose.rotation).amax() < 1e-8, "{omega:?}, notation {k}");
            }
        }
    }

    #[test]
    fn the_matrix_has_the_digits_of_json() {
        let pose = Rigid::exp(&Vector6::new(1e-9, 2.0, -0.3, 4.5e6, 1.0 / 3.0, 1e-12));
        let json = serde_json::to_string(&pose).unwrap();
        let rows: Vec<Vec<serde_json::Number>> = serde_json::from_str(&json).unwrap();
        let words: Vec<String> = rows.iter().flatten().map(ToString::to_string).collect();
        let told = notations(&pose);
        assert_eq!(told[0].text.split_whitespace().collect::<Vec<_>>(), words);
        assert!(!told[5].text.contains('e'));
    }
}
