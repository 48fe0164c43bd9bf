//! May a controller move by the newest transform?  The rules of "Messages on the wire" for a program in Rust.
//!
//! The messages alone: they come by the crate `zenoh`.  Times are all of one steady clock of this process
//! that goes on while the machine is suspended (see "How old a transform is"), in ns.
//!
//! ```text
//! gripmon/<robot>/<camera>/alive/*          liveliness subscriber with history: there(id), gone(id); the key's end
//! gripmon/<robot>/<camera>/transform        subscriber, ring of a few: transform(payload, attachment, now)
//! gripmon/<robot>/<camera>/transform?clock  get, once a second, real time and drop: clock(payload, asked, now)
//! ```

#![allow(dead_code)] // a controller needs more of the transform than the program beside this

use serde_json::Value;
use std::collections::{BTreeMap, BTreeSet};

/// Times, ns; a double would round the stamps.
pub type Ns = i64;

const MOST_DRIFT: f64 = 0.001; // of two steady clocks
const UNIT_TOLERANCE: f64 = 1e-3; // of a quaternion's length
const CLOCKS_KEPT: usize = 16; // a stranger may make up any number
const LARGEST_NS: u64 = 1 << 61; // 73 years: sums of three stay within 64 bits

/// `cam_T_grip`, gripper to camera: p_cam = R p_grip + t.
#[derive(Clone, Debug, Default)]
pub struct Transform {
    pub verdict: String,
    pub reason: String,
    pub monitor_id: String,
    pub reference_id: String,
    pub revision: Ns,
    pub latency_ns: Ns,
    pub translation_m: [f64; 3],
    pub rotation_xyzw: [f64; 4],
    /// Bound on the error of the TCP's position.
    pub protection_m: f64,
}

/// The monitor's clock was ahead of ours by `most_ns` at most, `at_ns` by ours.
#[derive(Clone, Copy)]
struct Lead {
    most_ns: Ns,
    at_ns: Ns,
}

impl Lead {
    fn at(self, when_ns: Ns) -> Ns {
        self.most_ns + (MOST_DRIFT * (when_ns - self.at_ns).abs() as f64).ceil() as Ns
    }
}

struct Entry {
    transform: Transform,
    arrived_ns: Ns,
    clock: String,
    sent_ns: Ns,
}

pub struct Reader {
    max_age_ns: Ns,
    there: BTreeSet<String>,
    newest: Result<Option<Entry>, String>,
    leads: BTreeMap<String, Lead>,
}

impl Reader {
    pub fn new(max_age_ns: Ns) -> Self {
        Self { max_age_ns, there: BTreeSet::new(), newest: Ok(None), leads: BTreeMap::new() }
    }

    pub fn there(&mut self, monitor_id: &str) {
        self.there.insert(monitor_id.to_string());
    }

    pub fn gone(&mut self, monitor_id: &str) {
        self.there.remove(monitor_id);
    }

    /// A message that is none is kept as the reason: what it would have said is not known.
    pub fn transform(&mut self, payload: &[u8], attachment: &[u8], arrived_ns: Ns) {
        self.newest = entry(payload, attachment, arrived_ns).map(Some);
        if let Ok(Some(entry)) = &self.newest {
            let lead = self.leads.get(&entry.clock);
            if lead.map_or(false, |lead| arrived_ns + lead.at(arrived_ns) < entry.sent_ns) {
                self.leads.remove(&entry.clock); // a clock jumped
            }
        }
    }

    /// The answer says what the monitor's clock showed after the question: it is ahead of ours by that difference at
    /// most.  What is no answer changes nothing.
    pub fn clock(&mut self, payload: &[u8], asked_ns: Ns, answered_ns: Ns) {
        let (clock, shown_ns) = match reading(payload) {
            Ok(answer) => answer,
            Err(_) => return,
        };
        let first = Lead { most_ns: shown_ns - asked_ns, at_ns: asked_ns };
        let lead = Lead { most_ns: first.at(answered_ns), at_ns: asked_ns }; // it drifted meanwhile
        let known = self.leads.get(&clock).map(|known| known.at(answered_ns));
        if known.map_or(true, |known_ns| known_ns < shown_ns - answered_ns || lead.at(answered_ns) < known_ns) {
            self.leads.insert(clock.clone(), lead);
        }
        if self.leads.len() > CLOCKS_KEPT {
            let other = self.leads.keys().find(|name| **name != clock).cloned();
            other.map(|name| self.leads.remove(&name));
        }
    }

    /// The transform, or why there is none to move by.
    pub fn newest(&self, now_ns: Ns) -> Result<&Transform, String> {
        if self.there.len() > 1 {
            return Err("two monitors have this name".to_string());
        }
        let newest = self.newest.as_ref().map_err(|why| format!("the last transform can't be read: {why}"))?;
        let entry = newest.as_ref().ok_or("no transform came yet")?;
        let transform = &entry.transform;
        if !self.there.contains(&transform.monitor_id) {
            return Err("its monitor is gone".to_string());
        }
        if transform.verdict != "valid" && transform.verdict != "suspect" {
            return Err(format!("unknown: {}", transform.reason));
        }
        let lead = self.leads.get(&entry.clock).ok_or("its age is not known")?;
        let on_its_way_ns = entry.arrived_ns + lead.at(entry.arrived_ns) - entry.sent_ns;
        if transform.latency_ns + on_its_way_ns + now_ns - entry.arrived_ns > self.max_age_ns {
            return Err("it is too old".to_string());
        }
        if transform.verdict == "suspect" {
            return Err(format!("suspect: {}", transform.reason));
        }
        Ok(transform)
    }
}

fn message(payload: &[u8], schema: &str) -> Result<Value, String> {
    let json: Value = serde_json::from_slice(payload).map_err(|error| error.to_string())?;
    match json.get("schema") {
        None if json.is_object() => Ok(json),
        Some(said) if said == schema => Ok(json),
        said => Err(format!("not {schema} but {}", said.unwrap_or(&json))),
    }
}

fn reading(payload: &[u8]) -> Result<(String, Ns), String> {
    let json = message(payload, "gripmon.clock/1")?;
    Ok((text(&json, "clock").ok_or("clock is no text")?, whole(&json, "now_ns")?))
}

fn whole(json: &Value, name: &str) -> Result<Ns, String> {
    let value = json[name].as_u64().filter(|value| *value <= LARGEST_NS);
    value.map(|value| value as Ns).ok_or(format!("{name} is no time or count"))
}

fn text(json: &Value, name: &str) -> Option<String> {
    json[name].as_str().map(str::to_string)
}

fn numbers<const N: usize>(json: &Value) -> Option<[f64; N]> {
    let values: Option<Vec<f64>> = json.as_array()?.iter().map(Value::as_f64).collect();
    values?.try_into().ok()
}

fn entry(payload: &[u8], attachment: &[u8], arrived_ns: Ns) -> Result<Entry, String> {
    let transform = transform(payload)?;
    let (clock, sent_ns) = reading(attachment)?;
    Ok(Entry { transform, arrived_ns, clock, sent_ns })
}

fn transform(payload: &[u8]) -> Result<Transform, String> {
    let json = message(payload, "gripmon.transform/2")?;
    let mut out = Transform {
        verdict: text(&json, "verdict").ok_or("no verdict")?,
        reason: text(&json, "reason").unwrap_or_default(),
        monitor_id: text(&json, "monitor_id").unwrap_or_default(),
        reference_id: text(&json, "reference_id").ok_or("no reference_id")?,
        revision: whole(&json, "revision")?,
        latency_ns: whole(&json, "latency_ns")?,
        ..Transform::default()
    };
    if out.verdict != "valid" && out.verdict != "suspect" {
        return Ok(out); // the closed enumeration: all else is unknown
    }
    let pose = &json["cam_T_grip"];
    let not_a_pose = "a transform that is not a pose";
    out.translation_m = numbers(&pose["translation_m"]).ok_or(not_a_pose)?;
    out.rotation_xyzw = numbers(&pose["rotation_xyzw"]).ok_or(not_a_pose)?;
    let length = out.rotation_xyzw.iter().map(|each| each * each).sum::<f64>().sqrt();
    out.protection_m = json["protection"]["position_m"].as_f64().ok_or("no protection level")?;
    match ((length - 1.0).abs() < UNIT_TOLERANCE, out.protection_m >= 0.0) {
        (false, _) => Err(not_a_pose.to_string()),
        (_, false) => Err("a protection level below 0".to_string()),
        _ => Ok(out),
    }
}
