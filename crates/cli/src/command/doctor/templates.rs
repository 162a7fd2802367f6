//! Templates: whether their programs exist and may be started.

use super::Findings;
use ratn_daemon::process_manager::ProcessManagerConfig;

pub(super) fn check(findings: &mut Findings, config: &ProcessManagerConfig) {
    for template in &config.templates {
        let about = format!("template {}", template.name);
        match template.obstacle() {
            Some(obstacle) => findings.problem(
                about,
                obstacle,
                "if its workers run on another host, this is well there: `ratn doctor` on that host says so",
            ),
            None => findings.ok(about, template.interpreter().as_deref().unwrap_or("what it starts is there")),
        }
    }
}
