//! Redis, if it is installed: a script that takes three keys, all or none. In memory only, as it comes.

use super::process::{Process, installed};
use super::times::Times;
use std::path::Path;
use std::time::Instant;
use tokio::io::{AsyncBufReadExt, AsyncWriteExt, BufReader};
use tokio::net::TcpStream;

const ACQUIRE: &str = "for _, key in ipairs(KEYS) do if redis.call('EXISTS', key) == 1 then return 0 end end \
     for _, key in ipairs(KEYS) do redis.call('SET', key, ARGV[1]) end return 1";

pub(crate) struct Redis {
    connection: BufReader<TcpStream>,
}

impl Redis {
    pub(crate) async fn start(directory: &Path) -> Option<(Process, Redis)> {
        let place = directory.display().to_string();
        let arguments = |port: u16| {
            let port = port.to_string();
            let options = ["--port", &port, "--bind", "127.0.0.1", "--save", "", "--appendonly", "no", "--dir", &place];
            options.iter().map(|&option| option.to_owned()).collect()
        };
        let (process, port) = installed("redis-server", arguments).await?;
        let connection = TcpStream::connect(("127.0.0.1", port)).await.unwrap();
        connection.set_nodelay(true).unwrap();
        Some((process, Redis { connection: BufReader::new(connection) }))
    }

    /// Sends a command, and reads an answer of one line.
    async fn ask(&mut self, words: &[&str]) -> String {
        let mut command = format!("*{}\r\n", words.len());
        for word in words {
            command.push_str(&format!("${}\r\n{word}\r\n", word.len()));
        }
        self.connection.write_all(command.as_bytes()).await.unwrap();
        let mut answer = String::new();
        self.connection.read_line(&mut answer).await.unwrap();
        answer.trim_end().to_owned()
    }

    pub(crate) async fn acquire_three(&mut self, count: usize, times: &mut Times) {
        for _ in 0..count {
            let began = Instant::now();
            assert_eq!(self.ask(&["EVAL", ACQUIRE, "3", "a", "b", "c", "holder"]).await, ":1", "nobody has them");
            times.add(began);
            assert_eq!(self.ask(&["DEL", "a", "b", "c"]).await, ":3");
        }
    }
}
