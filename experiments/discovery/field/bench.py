"""The field benchmark: every case is another robot."""

from pathlib import Path

from experiments.discovery.benchmark import Benchmark
from experiments.discovery.field.cases import FIELD_SIZES, FieldCase, cases
from experiments.discovery.field.writing import write_case


class FieldBench(Benchmark):
    """The cases of the field benchmark.

    Args:
      out: folder of the benchmark.
      size: one of `cases.FIELD_SIZES`.
      seed: of everything random. After somebody has looked at the cases of a seed and improved discovery with them,
        they are no test any more.
      nominal_error: relative error of the nominal parameters.
    """

    def __init__(self, out: Path, size: str, seed: int, nominal_error: float):
        super().__init__(out)
        self._seed, self._nominal_error = seed, nominal_error
        self.cases: list[FieldCase] = cases(FIELD_SIZES[size], seed)

    def write(self, case: FieldCase) -> Path:
        """Writes a case's log, and its truth into the folder that only `scored` reads, unless they exist.

        Returns:
          Folder of the log.
        """
        return write_case(case, self._nominal_error, self._seed, self.out)
