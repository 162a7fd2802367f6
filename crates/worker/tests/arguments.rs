//! What a worker process is started with, and what a goal's inputs are: taken, or refused by name.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

mod arguments {
    use ratn_worker::arguments::{ArgumentError, Arguments};

    fn read(arguments: &str, pooled: bool) -> Result<Arguments, ArgumentError> {
        Arguments::of(arguments.split_whitespace().map(str::to_owned).collect(), pooled)
    }

    #[test]
    fn a_template_s_arguments_make_a_worker() {
        let mut arguments =
            read("--id labels-1@compute --endpoint-file /run/e --speed 8 --listen=unix:/run/s", true).unwrap();
        assert_eq!(arguments.take::<f64>("--speed"), Ok(Some(8.0)));
        assert_eq!(arguments.take::<u32>("--depth"), Ok(None));
        let options = arguments.options().unwrap();
        assert_eq!((options.id.as_str(), options.listen.to_string().as_str()), ("labels-1@compute", "unix:/run/s"));
        assert!(options.exit_with_parent, "as every worker of a process manager");
        assert!(!read("--id a", false).unwrap().options().unwrap().exit_with_parent);
    }

    #[test]
    fn a_bad_argument_is_refused_by_name() {
        let refused = |arguments: &str| {
            let read = read(arguments, false).and_then(|mut arguments| {
                arguments.take::<f64>("--speed")?;
                arguments.options()
            });
            read.unwrap_err().to_string()
        };
        assert_eq!(refused("--id"), "--id needs a value");
        assert_eq!(refused("--id a --id b"), "--id is given twice");
        assert_eq!(
            refused("--id a --insecure=false"),
            "--insecure is `false`: it stands without a value: leave it out, or give it alone"
        );
        assert_eq!(refused("--speed fast"), "--speed is `fast`: invalid float literal");
        assert!(refused("--listen nowhere").starts_with("--listen is `nowhere`: "));
        let unknown = refused("--sped 3");
        assert!(
            unknown.starts_with("there is no option `--sped`; there are --id,") && unknown.ends_with("--speed"),
            "{unknown}"
        );
        assert!(refused("nearest").starts_with("there is no option `nearest`"));
    }
}

mod signature {
    use ratn_worker::prelude::*;

    fn signature() -> Signature {
        Signature::new()
            .input("at", Type::Pose)
            .with_default("tries", Type::Int, Value::Int(3))
            .optional("within_m", Type::Float)
            .output("text", Type::String)
    }

    #[test]
    fn what_does_not_fit_is_refused_with_the_action_and_the_port() {
        let complete = |inputs: &[(&str, Value)]| {
            let mut inputs = inputs.iter().map(|(name, value)| ((*name).to_owned(), value.clone())).collect();
            signature().complete("read", &mut inputs).map(|()| inputs).map_err(|error| error.to_string())
        };
        let at = || ("at", Value::Pose(Pose::IDENTITY));
        assert_eq!(complete(&[]).unwrap_err(), "input `at` of `read` is missing: expected pose");
        assert_eq!(complete(&[("at", Value::Int(1))]).unwrap_err(), "input `at` of `read` is a int: expected pose");
        let unknown = complete(&[at(), ("witin_m", Value::Float(1.0))]).unwrap_err();
        assert_eq!(unknown, "`read` has no input `witin_m`; it has at, tries, within_m");
        let inputs = complete(&[at(), ("within_m", Value::Null)]).unwrap();
        assert_eq!((&inputs["tries"], inputs.get("within_m")), (&Value::Int(3), Some(&Value::Null)));
        assert_eq!(complete(&[at(), ("tries", Value::Int(9))]).unwrap()["tries"], Value::Int(9));
    }

    #[test]
    fn an_output_that_is_not_as_said_is_found_with_success_only() {
        let check = |outcome: GoalOutcome| signature().check("read", &outcome).map_err(|error| error.to_string());
        let success = GoalOutcome::success;
        assert!(check(success()).unwrap_err().contains("its output `text` is missing: expected string"));
        assert!(check(success().with_output("text", Value::Int(1))).unwrap_err().contains("is int"));
        assert_eq!(check(success().with_output("text", Value::String("x".to_owned()))), Ok(()));
        assert_eq!(check(GoalOutcome::aborted("no label")), Ok(()));
    }
}

mod inputs {
    use ratn_model::value::Value;
    use ratn_worker::action::Port;

    #[test]
    fn a_wrong_input_is_named_with_its_action() {
        let region = Value::map([("size", Value::List(vec![Value::Int(1)].into()))]);
        let port = Port::of("segment", "region", Some(&region));
        let missing = port.field("pose").pose().unwrap_err().to_string();
        assert_eq!(missing, "input `region.pose` of `segment` is missing: expected a pose");
        let element = port.field("size").list().unwrap()[0].string().unwrap_err().to_string();
        assert_eq!(element, "input `region.size[0]` of `segment` is the int 1: expected a string");
    }
}
