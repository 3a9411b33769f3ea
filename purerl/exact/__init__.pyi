# The public names, each once; `__init__.py` reads this list.
from purerl.exact.kernel.choosing import with_kernel as with_kernel
from purerl.exact.kernel.compiling import (
    compile_kernel as compile_kernel,
    kernel_agreement as kernel_agreement,
    kernel_missing as kernel_missing,
)
from purerl.exact.order import (
    ScatterSum as ScatterSum,
    unordered_in as unordered_in,
    unordered_sums as unordered_sums,
)
from purerl.exact.portable import without_libraries as without_libraries
from purerl.exact.rewriting import rewrite as rewrite
from purerl.exact.xla_flags import (
    TRITON_REDUCTIONS as TRITON_REDUCTIONS,
    equal_passes as equal_passes,
    how_chosen as how_chosen,
    is_portable as is_portable,
    set_portable_flags as set_portable_flags,
    set_xla_flags as set_xla_flags,
)
