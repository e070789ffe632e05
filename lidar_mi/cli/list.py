"""``lidar-mi list``: the experiments and campaigns that come with the package."""

from lidar_mi.cli.terminal import output, print_rows

EXAMPLES = ("lidar-mi list",)


def list_shipped() -> None:
    """List the experiments and campaigns of the package: their questions, and what they need."""
    from lidar_mi.schema.shipped import campaigns, experiments, flights, question_and_needs

    flown = flights()
    groups = {
        "experiments: lidar-mi run NAME": [each for each in experiments() if each not in flown],
        "flights: lidar-mi fly NAME": flown,
        "campaigns: lidar-mi campaign run NAME": campaigns(),
    }
    for title, names in groups.items():
        print_rows(title, [(name, *question_and_needs(name)) for name in names])
    output.print("times of two cores; of this machine: lidar-mi check NAME --forecast")
    output.print("a file of your own from one of them: lidar-mi new MY_NAME --from NAME")
