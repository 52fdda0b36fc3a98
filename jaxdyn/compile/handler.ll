; What XLA calls for every kernel of jaxdyn: a typed FFI handler (xla/ffi/api/c_api.h, version 0.3), without C++ and without Python.
;
; It looks the kernel up in the process's table by the hash in the call's attribute, checks that every buffer has the size the kernel
; was written for, and runs it: on this thread where there are few samples, else in chunks that the threads of XLA's own pool and this
; one claim in turn. This thread waits only for chunks that others have begun, so a busy pool cannot block it.
;
; A kernel that is called for the first time has no machine code yet: `prepare`, a function of Python's, makes it, and stores its
; address in the table. Kernels that are never called, as of branches that are not taken, cost nothing.
;
; Names in braces are filled in by target.py. A table entry is { hash, kernel, chunk, minimum, buffers, sizes }: `chunk` samples are
; claimed at a time, fewer than `minimum` stay on one thread, and sizes[i] is the number of entries per sample of buffer i, or less than
; zero (minus one, less the number of entries) for an argument that is the same for all samples.

declare ptr @malloc(i64)
declare void @free(ptr)
declare void @llvm.memcpy.p0.p0.i64(ptr, ptr, i64, i1)
declare {RELAX_TYPE}
; Of the process: `target.register` says where they are.
@{TABLE} = external global i8
@jaxdyn_limit = external global i64
@jaxdyn_failures = external global i64
declare ptr @jaxdyn_prepare(i64)

@missing = private constant [{MISSING_BYTES} x i8] c"{MISSING}\00"
@failed = private constant [{FAILED_BYTES} x i8] c"{FAILED}\00"
@misfit = private constant [{MISFIT_BYTES} x i8] c"{MISFIT}\00"

%Entry = type { i64, ptr, i64, i64, i64, ptr }
; A batch that is shared between threads. What is counted atomically stands on cache lines of its own. The first field is where the
; address of the kernel is, which changes when there is better code.
;               address  data samples chunk chunks, references, -, next, -, done
%Job = type { ptr, ptr, i64, i64, i64, i64, [8 x i64], i64, [8 x i64], i64 }

; XLA's structures, as far as they are read: size of the structure, extensions, ...
%Api = type { i64, ptr, i64, ptr, i64, ptr, ptr, ptr, ptr, ptr, ptr, ptr, ptr, ptr, ptr, ptr, ptr, ptr, ptr }
%Extension = type { i64, i64, ptr }
%Version = type { i64, ptr, i32, i32 }
%Metadata = type { i64, %Version, i32 }
%MetadataExtension = type { i64, i32, ptr, ptr }
%Buffer = type { i64, ptr, i32, ptr, i64, ptr }
%List = type { i64, ptr, i64, ptr, ptr }
%Attributes = type { i64, ptr, i64, ptr, ptr, ptr }
%Frame = type { i64, ptr, ptr, ptr, i32, %List, %List, %Attributes, ptr }

; Claim chunks until there are none.
define internal void @work(ptr %job) #0 {
entry:
  %address.at = getelementptr %Job, ptr %job, i32 0, i32 0
  %address = load ptr, ptr %address.at
  %data.at = getelementptr %Job, ptr %job, i32 0, i32 1
  %data = load ptr, ptr %data.at
  %n.at = getelementptr %Job, ptr %job, i32 0, i32 2
  %n = load i64, ptr %n.at
  %chunk.at = getelementptr %Job, ptr %job, i32 0, i32 3
  %chunk = load i64, ptr %chunk.at
  %chunks.at = getelementptr %Job, ptr %job, i32 0, i32 4
  %chunks = load i64, ptr %chunks.at
  %next.at = getelementptr %Job, ptr %job, i32 0, i32 7
  %done.at = getelementptr %Job, ptr %job, i32 0, i32 9
  br label %claim
claim:
  %mine = atomicrmw add ptr %next.at, i64 1 seq_cst
  %is.some = icmp slt i64 %mine, %chunks
  br i1 %is.some, label %run, label %out
run:
  %begin = mul i64 %mine, %chunk
  %far = add i64 %begin, %chunk
  %is.inside = icmp slt i64 %far, %n
  %end = select i1 %is.inside, i64 %far, i64 %n
  %kernel = load atomic ptr, ptr %address acquire, align 8
  call void %kernel(ptr %data, i64 %n, i64 %begin, i64 %end)
  %before = atomicrmw add ptr %done.at, i64 1 seq_cst
  br label %claim
out:
  ret void
}

; Give up one reference to a job; the last one frees it.
define internal void @leave(ptr %job) #0 {
entry:
  %references.at = getelementptr %Job, ptr %job, i32 0, i32 5
  %before = atomicrmw sub ptr %references.at, i64 1 seq_cst
  %is.last = icmp eq i64 %before, 1
  br i1 %is.last, label %drop, label %out
drop:
  call void @free(ptr %job)
  ret void
out:
  ret void
}

; What a thread of the pool runs.
define internal void @task(ptr %job) #0 {
  call void @work(ptr %job)
  call void @leave(ptr %job)
  ret void
}

; Destroy an error of XLA's that is not passed on.
define internal void @forget(ptr %api, ptr %error) #0 {
  %args = alloca [3 x i64]
  store i64 24, ptr %args
  %extension = getelementptr [3 x i64], ptr %args, i32 0, i32 1
  store ptr null, ptr %extension
  %error.at = getelementptr [3 x i64], ptr %args, i32 0, i32 2
  store ptr %error, ptr %error.at
  %destroy.at = getelementptr %Api, ptr %api, i32 0, i32 8
  %destroy = load ptr, ptr %destroy.at
  call void %destroy(ptr %args)
  ret void
}

define internal ptr @failure(ptr %api, ptr %message, i32 %code) #0 {
  %args = alloca [4 x i64]
  store i64 28, ptr %args
  %extension = getelementptr [4 x i64], ptr %args, i32 0, i32 1
  store ptr null, ptr %extension
  %message.at = getelementptr [4 x i64], ptr %args, i32 0, i32 2
  store ptr %message, ptr %message.at
  %code.at = getelementptr [4 x i64], ptr %args, i32 0, i32 3
  store i32 %code, ptr %code.at
  %create.at = getelementptr %Api, ptr %api, i32 0, i32 6
  %create = load ptr, ptr %create.at
  %error = call ptr %create(ptr %args)
  ret ptr %error
}

; The table's entry for a hash, or null: linear probing.
define internal ptr @look_up(i64 %hash) #0 {
entry:
  br label %look
look:
  %probe = phi i64 [ %hash, %entry ], [ %probe.next, %other ]
  %slot = and i64 %probe, {SLOT_MASK}
  %here = getelementptr %Entry, ptr @{TABLE}, i64 %slot
  %found = load atomic i64, ptr %here acquire, align 8
  %is.same = icmp eq i64 %found, %hash
  br i1 %is.same, label %hit, label %other
other:
  %probe.next = add i64 %probe, 1
  %is.free = icmp eq i64 %found, 0
  br i1 %is.free, label %miss, label %look
hit:
  ret ptr %here
miss:
  ret ptr null
}

; Number of entries of a buffer's leading `rank` dimensions.
define internal i64 @entries(ptr %buffer, i64 %rank) #0 {
entry:
  %dims.at = getelementptr %Buffer, ptr %buffer, i32 0, i32 5
  %dims = load ptr, ptr %dims.at
  br label %loop
loop:
  %k = phi i64 [ 0, %entry ], [ %k.next, %more ]
  %size = phi i64 [ 1, %entry ], [ %size.next, %more ]
  %is.done = icmp sge i64 %k, %rank
  br i1 %is.done, label %out, label %more
more:
  %dim.at = getelementptr i64, ptr %dims, i64 %k
  %dim = load i64, ptr %dim.at
  %size.next = mul i64 %size, %dim
  %k.next = add i64 %k, 1
  br label %loop
out:
  ret i64 %size
}

; Write the addresses of a list's buffers to `data`; whether each has n times, or once, the entries it should have.
define internal i1 @gather(ptr %list, ptr %data, ptr %sizes, i64 %n) #0 {
entry:
  %count.at = getelementptr %List, ptr %list, i32 0, i32 2
  %count = load i64, ptr %count.at
  %buffers.at = getelementptr %List, ptr %list, i32 0, i32 4
  %buffers = load ptr, ptr %buffers.at
  br label %loop
loop:
  %i = phi i64 [ 0, %entry ], [ %i.next, %step ]
  %fits = phi i1 [ true, %entry ], [ %fits.next, %step ]
  %is.done = icmp sge i64 %i, %count
  br i1 %is.done, label %out, label %step
step:
  %buffer.at = getelementptr ptr, ptr %buffers, i64 %i
  %buffer = load ptr, ptr %buffer.at
  %address.at = getelementptr %Buffer, ptr %buffer, i32 0, i32 3
  %address = load ptr, ptr %address.at
  %to = getelementptr ptr, ptr %data, i64 %i
  store ptr %address, ptr %to
  %rank.at = getelementptr %Buffer, ptr %buffer, i32 0, i32 4
  %rank = load i64, ptr %rank.at
  %have = call i64 @entries(ptr %buffer, i64 %rank)
  %size.at = getelementptr i64, ptr %sizes, i64 %i
  %size = load i64, ptr %size.at
  %for.all = sub i64 -1, %size
  %for.each = mul i64 %size, %n
  %is.uniform = icmp slt i64 %size, 0
  %needed = select i1 %is.uniform, i64 %for.all, i64 %for.each
  %is.fitting = icmp eq i64 %have, %needed
  %fits.next = and i1 %fits, %is.fitting
  %i.next = add i64 %i, 1
  br label %loop
out:
  ret i1 %fits
}

; Threads of XLA's pool, at most as many as are allowed.
define internal i64 @threads(ptr %api, ptr %context) #0 {
entry:
  %count.at = alloca i64
  store i64 1, ptr %count.at
  %args = alloca [4 x i64]
  store i64 32, ptr %args
  %extension = getelementptr [4 x i64], ptr %args, i32 0, i32 1
  store ptr null, ptr %extension
  %context.at = getelementptr [4 x i64], ptr %args, i32 0, i32 2
  store ptr %context, ptr %context.at
  %result.at = getelementptr [4 x i64], ptr %args, i32 0, i32 3
  store ptr %count.at, ptr %result.at
  %ask.at = getelementptr %Api, ptr %api, i32 0, i32 18
  %ask = load ptr, ptr %ask.at
  %error = call ptr %ask(ptr %args)
  %is.error = icmp ne ptr %error, null
  br i1 %is.error, label %none, label %some
none:
  call void @forget(ptr %api, ptr %error)
  ret i64 1
some:
  %count = load i64, ptr %count.at
  %limit = load i64, ptr @jaxdyn_limit
  %is.less = icmp slt i64 %count, %limit
  %allowed = select i1 %is.less, i64 %count, i64 %limit
  ret i64 %allowed
}

define internal void @in_parallel(ptr %api, ptr %context, ptr %address, ptr %data, i64 %n, i64 %chunk, i64 %chunks, i64 %threads) #0 {
entry:
  %args = alloca [5 x i64]
  %job.end = getelementptr %Job, ptr null, i32 1
  %job.bytes = ptrtoint ptr %job.end to i64
  %job = call ptr @malloc(i64 %job.bytes)
  store %Job zeroinitializer, ptr %job
  store ptr %address, ptr %job
  %data.at = getelementptr %Job, ptr %job, i32 0, i32 1
  store ptr %data, ptr %data.at
  %n.at = getelementptr %Job, ptr %job, i32 0, i32 2
  store i64 %n, ptr %n.at
  %chunk.at = getelementptr %Job, ptr %job, i32 0, i32 3
  store i64 %chunk, ptr %chunk.at
  %chunks.at = getelementptr %Job, ptr %job, i32 0, i32 4
  store i64 %chunks, ptr %chunks.at
  %references.at = getelementptr %Job, ptr %job, i32 0, i32 5
  store i64 %threads, ptr %references.at
  %schedule.at = getelementptr %Api, ptr %api, i32 0, i32 17
  %schedule = load ptr, ptr %schedule.at
  br label %loop
loop:
  %i = phi i64 [ 1, %entry ], [ %i.next, %scheduled ]
  %is.done = icmp sge i64 %i, %threads
  br i1 %is.done, label %own, label %ask
ask:
  store i64 40, ptr %args
  %extension = getelementptr [5 x i64], ptr %args, i32 0, i32 1
  store ptr null, ptr %extension
  %context.at = getelementptr [5 x i64], ptr %args, i32 0, i32 2
  store ptr %context, ptr %context.at
  %task.at = getelementptr [5 x i64], ptr %args, i32 0, i32 3
  store ptr @task, ptr %task.at
  %job.at = getelementptr [5 x i64], ptr %args, i32 0, i32 4
  store ptr %job, ptr %job.at
  %error = call ptr %schedule(ptr %args)
  %is.error = icmp ne ptr %error, null
  br i1 %is.error, label %refused, label %scheduled
refused:
  call void @forget(ptr %api, ptr %error)
  call void @leave(ptr %job)
  br label %scheduled
scheduled:
  %i.next = add i64 %i, 1
  br label %loop
own:
  call void @work(ptr %job)
  %done.at = getelementptr %Job, ptr %job, i32 0, i32 9
  br label %wait
wait:
  %done = load atomic i64, ptr %done.at acquire, align 8
  %is.all = icmp sge i64 %done, %chunks
  br i1 %is.all, label %out, label %spin
spin:
  call {RELAX}
  br label %wait
out:
  call void @leave(ptr %job)
  ret void
}

; XLA asks which version of the interface a handler was written for.
define internal void @describe(ptr %extension) #0 {
  %metadata.at = getelementptr %MetadataExtension, ptr %extension, i32 0, i32 3
  %metadata = load ptr, ptr %metadata.at
  %major.at = getelementptr %Metadata, ptr %metadata, i32 0, i32 1, i32 2
  store i32 {MAJOR}, ptr %major.at
  %minor.at = getelementptr %Metadata, ptr %metadata, i32 0, i32 1, i32 3
  store i32 {MINOR}, ptr %minor.at
  %traits.at = getelementptr %Metadata, ptr %metadata, i32 0, i32 2
  store i32 0, ptr %traits.at
  ret void
}

; The code of an entry, made by Python where there is none yet; null where that fails, as for an entry that is null.
define internal ptr @code(ptr %entry.at, i64 %hash) #0 {
  %is.there = icmp ne ptr %entry.at, null
  br i1 %is.there, label %look, label %new
look:
  %kernel.at = getelementptr %Entry, ptr %entry.at, i32 0, i32 1
  %ready = load atomic ptr, ptr %kernel.at acquire, align 8
  %is.ready = icmp ne ptr %ready, null
  br i1 %is.ready, label %old, label %new
old:
  ret ptr %ready
new:
  %made = call ptr @jaxdyn_prepare(i64 %hash)
  ret ptr %made
}

; Copy one sample of arrays to rows in memory, which begins with their addresses, or back. A layout is { entries, bytes of an entry,
; bytes from entry to entry and from sample to sample, place of the row }.
define internal void @move(i64 %sample, i64 %first, i64 %count, ptr %bases, ptr %layouts, ptr %memory, i1 %is.back) #0 {
entry:
  br label %arrays
arrays:
  %i = phi i64 [ %first, %entry ], [ %i.next, %next ]
  %is.done = icmp sge i64 %i, %count
  br i1 %is.done, label %out, label %array
array:
  %layout = getelementptr [5 x i64], ptr %layouts, i64 %i
  %numbers = load [5 x i64], ptr %layout
  %entries = extractvalue [5 x i64] %numbers, 0
  %bytes = extractvalue [5 x i64] %numbers, 1
  %step = extractvalue [5 x i64] %numbers, 2
  %stride = extractvalue [5 x i64] %numbers, 3
  %place = extractvalue [5 x i64] %numbers, 4
  %base.at = getelementptr ptr, ptr %bases, i64 %i
  %base = load ptr, ptr %base.at
  %offset = mul i64 %sample, %stride
  %row = getelementptr i8, ptr %memory, i64 %place
  %row.at = getelementptr ptr, ptr %memory, i64 %i
  store ptr %row, ptr %row.at
  br label %loop
loop:
  %k = phi i64 [ 0, %array ], [ %k.next, %more ]
  %is.last = icmp sge i64 %k, %entries
  br i1 %is.last, label %next, label %more
more:
  %far = mul i64 %k, %step
  %far.offset = add i64 %far, %offset
  %near = mul i64 %k, %bytes
  %there = getelementptr i8, ptr %base, i64 %far.offset
  %here = getelementptr i8, ptr %row, i64 %near
  %from = select i1 %is.back, ptr %here, ptr %there
  %to = select i1 %is.back, ptr %there, ptr %here
  call void @llvm.memcpy.p0.p0.i64(ptr %to, ptr %from, i64 %bytes, i1 false)
  %k.next = add i64 %k, 1
  br label %loop
next:
  %i.next = add i64 %i, 1
  br label %arrays
out:
  ret void
}

; Compute those of `width` samples whose bits are set by the kernel of one sample with this number. Other kernels call it for samples
; that are not valid. Where there is no code results stay as they are, and `handler` reports the failure.
define void @careful(i64 %hash, i64 %width, i64 %mask, i64 %inputs, i64 %count, ptr %bases, ptr %layouts, ptr %memory) #0 {
entry:
  %entry.at = call ptr @look_up(i64 %hash)
  %kernel = call ptr @code(ptr %entry.at, i64 %hash)
  %is.made = icmp ne ptr %kernel, null
  br i1 %is.made, label %loop, label %out
loop:
  %k = phi i64 [ 0, %entry ], [ %k.next, %step ]
  %is.done = icmp sge i64 %k, %width
  br i1 %is.done, label %out, label %look
look:
  %shifted = lshr i64 %mask, %k
  %bit = trunc i64 %shifted to i1
  br i1 %bit, label %run, label %step
run:
  call void @move(i64 %k, i64 0, i64 %count, ptr %bases, ptr %layouts, ptr %memory, i1 false)
  call void %kernel(ptr %memory, i64 1, i64 0, i64 1)
  call void @move(i64 %k, i64 %inputs, i64 %count, ptr %bases, ptr %layouts, ptr %memory, i1 true)
  br label %step
step:
  %k.next = add i64 %k, 1
  br label %loop
out:
  ret void
}

define ptr @handler(ptr %frame) #0 {
entry:
  %extension.at = getelementptr %Frame, ptr %frame, i32 0, i32 1
  %extension = load ptr, ptr %extension.at
  %is.extended = icmp ne ptr %extension, null
  br i1 %is.extended, label %asked, label %execute
asked:
  %type.at = getelementptr %MetadataExtension, ptr %extension, i32 0, i32 1
  %type = load i32, ptr %type.at
  %is.metadata = icmp eq i32 %type, 1
  br i1 %is.metadata, label %metadata, label %execute
metadata:
  call void @describe(ptr %extension)
  ret ptr null
execute:
  %api.at = getelementptr %Frame, ptr %frame, i32 0, i32 2
  %api = load ptr, ptr %api.at
  %context.at = getelementptr %Frame, ptr %frame, i32 0, i32 3
  %context = load ptr, ptr %context.at
  %args = getelementptr %Frame, ptr %frame, i32 0, i32 5
  %results = getelementptr %Frame, ptr %frame, i32 0, i32 6
  %attributes.at = getelementptr %Frame, ptr %frame, i32 0, i32 7, i32 5
  %attributes = load ptr, ptr %attributes.at
  %scalar = load ptr, ptr %attributes
  %value.at = getelementptr { i32, ptr }, ptr %scalar, i32 0, i32 1
  %value = load ptr, ptr %value.at
  %hash = load i64, ptr %value
  %entry.at = call ptr @look_up(i64 %hash)
  %is.missing = icmp eq ptr %entry.at, null
  br i1 %is.missing, label %not.found, label %found
not.found:
  %error.missing = call ptr @failure(ptr %api, ptr @missing, i32 5)
  ret ptr %error.missing
found:
  %kernel = call ptr @code(ptr %entry.at, i64 %hash)
  %is.made = icmp ne ptr %kernel, null
  br i1 %is.made, label %go, label %not.made
not.made:
  %error.failed = call ptr @failure(ptr %api, ptr @failed, i32 13)
  ret ptr %error.failed
go:
  %failures = load atomic i64, ptr @jaxdyn_failures acquire, align 8
  %chunk.at = getelementptr %Entry, ptr %entry.at, i32 0, i32 2
  %chunk = load i64, ptr %chunk.at
  %minimum.at = getelementptr %Entry, ptr %entry.at, i32 0, i32 3
  %minimum = load i64, ptr %minimum.at
  %buffers.at = getelementptr %Entry, ptr %entry.at, i32 0, i32 4
  %buffers = load i64, ptr %buffers.at
  %sizes.at = getelementptr %Entry, ptr %entry.at, i32 0, i32 5
  %sizes = load ptr, ptr %sizes.at
  %args.count.at = getelementptr %List, ptr %args, i32 0, i32 2
  %args.count = load i64, ptr %args.count.at
  %results.count.at = getelementptr %List, ptr %results, i32 0, i32 2
  %results.count = load i64, ptr %results.count.at
  %count = add i64 %args.count, %results.count
  %is.counted = icmp eq i64 %count, %buffers
  br i1 %is.counted, label %measure, label %not.fitting
measure:
  ; Samples: the leading dimensions of the first result.
  %first.list = getelementptr %List, ptr %results, i32 0, i32 4
  %first.at = load ptr, ptr %first.list
  %first = load ptr, ptr %first.at
  %rank.at = getelementptr %Buffer, ptr %first, i32 0, i32 4
  %rank = load i64, ptr %rank.at
  %leading = sub i64 %rank, 1
  %n = call i64 @entries(ptr %first, i64 %leading)
  %data = alloca ptr, i64 %count
  %fits.args = call i1 @gather(ptr %args, ptr %data, ptr %sizes, i64 %n)
  %data.results = getelementptr ptr, ptr %data, i64 %args.count
  %sizes.results = getelementptr i64, ptr %sizes, i64 %args.count
  %fits.results = call i1 @gather(ptr %results, ptr %data.results, ptr %sizes.results, i64 %n)
  %fits = and i1 %fits.args, %fits.results
  br i1 %fits, label %choose, label %not.fitting
not.fitting:
  %error.misfit = call ptr @failure(ptr %api, ptr @misfit, i32 3)
  ret ptr %error.misfit
choose:
  %is.large = icmp sge i64 %n, %minimum
  br i1 %is.large, label %count.threads, label %alone
count.threads:
  %available = call i64 @threads(ptr %api, ptr %context)
  %padded = add i64 %n, %chunk
  %less.one = sub i64 %padded, 1
  %chunks = sdiv i64 %less.one, %chunk
  %is.fewer = icmp slt i64 %available, %chunks
  %threads = select i1 %is.fewer, i64 %available, i64 %chunks
  %is.one = icmp sle i64 %threads, 1
  br i1 %is.one, label %alone, label %parallel
alone:
  call void %kernel(ptr %data, i64 %n, i64 0, i64 %n)
  br label %check
parallel:
  %address = getelementptr %Entry, ptr %entry.at, i32 0, i32 1
  call void @in_parallel(ptr %api, ptr %context, ptr %address, ptr %data, i64 %n, i64 %chunk, i64 %chunks, i64 %threads)
  br label %check
check:
  ; A careful program that could not be made, of this call or of one at the same time.
  %failures.after = load atomic i64, ptr @jaxdyn_failures acquire, align 8
  %is.failed = icmp ne i64 %failures, %failures.after
  br i1 %is.failed, label %not.made, label %finished
finished:
  ret ptr null
}
attributes #0 = { nounwind }
