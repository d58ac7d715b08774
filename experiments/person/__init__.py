"""A scripted person who drives an imagined robot by keys, for `lerobot-record --robot.type=imagined`.

    python -m experiments.person.script --world_model=outputs/action_world_model --policy=outputs/policy \\
        --dataset.root=outputs/dataset --episodes=50 --frames=40 --output_dir=outputs/person
    PYTHONPATH=. lerobot-record --teleop.discover_packages_path=experiments.person \\
        --teleop.type=scripted_person --teleop.script=outputs/person/script.json \\
        --robot.dataset.episodes=[$(cat outputs/person/episodes.txt)] …

The person knows what to do from a policy and a planner in the same world model, but can only hold keys down:
each axis of the action moves at one speed, forwards, backwards or not at all. What a plan asks for in between
becomes presses now and then. Drives that fail are not recorded, as a person would record them again. At
success the person presses `n`, which ends an episode in lerobot-record.
"""

from experiments.person.teleoperator import ScriptedPerson, ScriptedPersonConfig

__all__ = ["ScriptedPerson", "ScriptedPersonConfig"]
