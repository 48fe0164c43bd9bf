//! What a controller would get, from messages on standard input: one line for each line "now".
//!
//!   there ID | gone ID | transform ARRIVED_NS PAYLOAD<tab>ATTACHMENT | clock ASKED_NS ANSWERED_NS PAYLOAD | now NS

mod reader;

use reader::{Ns, Reader};
use std::io::{self, BufRead, Write};

fn main() -> io::Result<()> {
    let mut reader = Reader::new(200_000_000);
    for line in io::stdin().lock().lines() {
        let line = line?;
        let (what, rest) = line.split_once(' ').unwrap_or((&line, ""));
        let (first, after) = rest.split_once(' ').unwrap_or((rest, ""));
        let time = |word: &str| word.parse::<Ns>().unwrap_or(0);
        match what {
            "there" => reader.there(rest),
            "gone" => reader.gone(rest),
            "transform" => {
                let (payload, attachment) = after.split_once('\t').unwrap_or((after, ""));
                reader.transform(payload.as_bytes(), attachment.as_bytes(), time(first));
            }
            "clock" => {
                let (second, payload) = after.split_once(' ').unwrap_or((after, ""));
                reader.clock(payload.as_bytes(), time(first), time(second));
            }
            "now" => match reader.newest(time(first)) {
                Err(why) => println!("don't: {why}"),
                Ok(found) => {
                    let values = found.translation_m.iter().chain(&found.rotation_xyzw).chain([&found.protection_m]);
                    let texts: Vec<String> = values.map(f64::to_string).collect();
                    println!("use {} {}", texts.join(" "), found.revision);
                }
            },
            _ => eprintln!("not understood: {what}"),
        }
        io::stdout().flush()?;
    }
    Ok(())
}
